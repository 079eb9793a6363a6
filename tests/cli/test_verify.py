"""The command verify."""

from __future__ import annotations

from support.commands import run

import lbt_synth as lbt


def test_verification_that_fails_has_status_1(tmp_path, capsys, monkeypatch, gains):
    design = lbt.load_gain(gains["kalman"])
    honest = type(design).recertify

    def strict(self):
        found = honest(self)
        checks = tuple(
            lbt.design.Check(
                name=c.name, value=c.limit + 1, limit=c.limit, computed_by=c.computed_by
            )
            for c in found.checks
        )
        return lbt.design.Certificate(
            checks=checks, gamma=found.gamma, rms_per_output=found.rms_per_output
        )

    monkeypatch.setattr(type(design), "recertify", strict)
    status, text, _ = run(capsys, "verify", gains["kalman"])
    assert status == 1
    assert "NOT VERIFIED" in text
