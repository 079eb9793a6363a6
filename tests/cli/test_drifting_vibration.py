"""Drifting vibrations at the command line."""

from __future__ import annotations

import json

from support.drifting import drift_file

from lbt_synth.cli.main import main


def test_the_commands_simulate_it_or_refuse(tmp_path, capsys):
    config, gain = str(drift_file(tmp_path)), str(tmp_path / "kalman.fits")
    assert main(["design", config, "--method", "kalman", "-o", gain]) == 0
    capsys.readouterr()
    assert main(["simulate", config, gain]) == 0
    out = capsys.readouterr().out
    assert "a vibration drifts" in out
    assert "least residual" not in out
    assert main(["simulate", config, gain, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["strehl_exact"] is None
    assert 0 < report["strehl"][0] < 1
    for refused in (
        ["limits", config, gain],
        ["robustness", config, "-o", str(tmp_path / "r.csv")],
        ["design", config, "--method", "integrator", "-o", str(tmp_path / "i.fits")],
    ):
        assert main(refused) == 2
        assert "drifts from 17 to 23 Hz" in " ".join(capsys.readouterr().err.split())
