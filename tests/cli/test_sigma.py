"""The command sigma."""

from __future__ import annotations

import json

from support.commands import run


def test_sigma(tmp_path, capsys, gains):
    out = tmp_path / "sigma.pdf"
    status, text, _ = run(capsys, "sigma", *gains.values(), "-o", out)
    assert status == 0
    assert out.read_bytes().startswith(b"%PDF")
    lines = {words[0]: words[1:] for words in map(str.split, text.splitlines()) if words}
    assert lines["quantity"] == ["kalman", "hinf", "integrator", "unit"]
    assert lines["norm"][-1] == "nm"
    assert "phase margin" in text
    data = json.loads(run(capsys, "sigma", gains["hinf"], "-o", out, "--json")[1])
    assert data["designs"]["hinf"]["stable"] is True
    assert data["units"]["phase_deg"] == "deg"
