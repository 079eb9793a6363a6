"""The command sigma."""

from __future__ import annotations

import json

from support.commands import run


def test_sigma(tmp_path, capsys, gains):
    out = tmp_path / "sigma.pdf"
    status, text, _ = run(capsys, "sigma", *gains.values(), "-o", out)
    assert status == 0
    assert out.read_bytes().startswith(b"%PDF")
    assert "norm [nm]" in text  # units survive the table
    data = json.loads(run(capsys, "sigma", gains["hinf"], "-o", out, "--json")[1])
    assert data["designs"]["hinf"]["stable"] is True
