"""Polytopic designs and priors on the command line."""

from __future__ import annotations

import json

import pytest
from support.plants import LBT_YAML
from support.vibration_config import write_vibration


def test_the_command_line(tmp_path, capsys):
    from lbt_synth.cli.main import main

    config, target = str(LBT_YAML), str(tmp_path / "p.fits")
    design = ["design", config, "--method", "polytopic", "-o", target]
    assert main([*design, "--half-width-hz", "0.5", "--norm", "h2"]) == 0
    assert main([*design, "--half-width-hz", "0.5"]) == 0
    capsys.readouterr()
    assert main(["show", target, "--matrices"]) == 0
    out = capsys.readouterr().out
    for text in (
        "norm on the interval, guaranteed",
        "norm on the interval, worst found",
        "guaranteed over found",
        "1.000000",
        "predictor_A",
    ):
        assert text in out
    assert main(["show", target, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["guaranteed_over_found"] == pytest.approx(1.0, abs=1e-6)
    assert shown["method"] == "polytopic-hinf"
    assert main(["verify", target]) == 0
    assert main(["sigma", target, "-o", str(tmp_path / "s.png")]) == 0
    assert main(["simulate", config, target, "--frames", "400", "--cases", "1"]) == 0
    capsys.readouterr()
    for wrong, text in (
        (design, "needs the half width of the interval of frequencies; try --half-width-hz 1"),
        (
            [*design, "--half-width-hz", "1", "--gamma", "200"],
            "--gamma goes with --method hinf or mixed; got --method polytopic",
        ),
        ([*design, "--half-width-hz", "1", "--taps", "3"], "--taps goes with --method mixed"),
        (
            [*design, "--half-width-hz", "1", "--route", "lmi"],
            "--method polytopic takes no --route",
        ),
        ([*design, "--half-width-hz", "25"], "must have a frequency above that"),
        (
            ["design", config, "--method", "kalman", "--norm", "h2", "-o", target],
            "--norm goes with --method polytopic; got --method kalman",
        ),
        (
            ["design", config, "--method", "hinf", "--half-width-hz", "1", "-o", target],
            "--half-width-hz goes with --method polytopic",
        ),
        (
            [
                "design",
                str(write_vibration(tmp_path, spread_hz=1.0)),
                "--method",
                "polytopic",
                "--half-width-hz",
                "1",
                "-o",
                target,
            ],
            "one uncertain frequency at a time",
        ),
    ):
        assert main(wrong) == 2
        assert text in capsys.readouterr().err
