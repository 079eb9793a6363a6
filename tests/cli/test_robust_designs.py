"""Robust designs on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.robust_config import SMALL, robust_writer

from lbt_synth.cli.main import main


@pytest.fixture
def small(tmp_path):
    return robust_writer(tmp_path)


def test_design_show_verify_sigma_and_simulate_take_a_robust_design(small, tmp_path, capsys):
    gain, picture = str(tmp_path / "robust.fits"), str(tmp_path / "sigma.png")
    config = small()
    assert main(["design", config, "--method", "robust", "-o", gain]) == 0
    assert "modulus margin" in capsys.readouterr().out
    assert main(["show", gain, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["method"] == "robust"
    assert shown["above_limit_percent"] > 0
    assert shown["limit_nm"] < shown["objective_nm"][0] * np.sqrt(2)
    assert len(shown["terms"]) == 4
    assert main(["verify", gain]) == 0
    assert main(["sigma", gain, "-o", picture]) == 0
    assert Path(picture).stat().st_size > 10_000
    assert main(["simulate", config, gain, "--frames", "500", "--cases", "1"]) == 0
    assert "Strehl ratio" in capsys.readouterr().out


def test_an_infeasible_file_names_what_clashes(small, tmp_path, capsys):
    section = (
        SMALL
        + """    modulus_margin: 0.8
    attenuation:
      - {low_hz: 0.0, high_hz: 60.0, at_most: 0.2}
"""
    )
    gain = tmp_path / "none.fits"
    assert main(["design", small(section), "--method", "robust", "-o", str(gain)]) == 1
    error = capsys.readouterr().err
    assert "these demands cannot hold" in error
    assert "attenuation to 0.2 in 0-60 Hz" in error
    assert not gain.exists()


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("\n  gamma_ratio: 1.2\n", "the key design.robust is missing"),
        (
            SMALL.replace("high_hz: 21.0", "high_hz: 18.0"),
            "design.robust.bands[0]: high_hz must be above 19",
        ),
        (SMALL.replace("high_hz: 21.0", "high_hz: 500.0"), "below the Nyquist frequency 400 Hz"),
        (SMALL.replace("rms_mas: 10.0", "rms_mas: -1.0"), "design.robust.bands[0].rms_mas"),
        (
            SMALL + "    attenuation:\n      - {low_hz: 3.0, high_hz: 2.0, at_most: 0.5}\n",
            "small.yaml: design.robust.attenuation[0]: high_hz must be above 3",
        ),
        (
            SMALL
            + "    mirror_uncertainty:\n      - {low_hz: 3.0, high_hz: 600.0, relative: 0.5}\n",
            "design.robust.mirror_uncertainty[0]: must lie below the Nyquist",
        ),
        (SMALL.replace("rms_mas: 10.0", "rms: 10.0"), "unknown key design.robust.bands[0].rms"),
        (
            SMALL + "    sensor_gain: [1.1, 1.3]\n",
            "design.robust.sensor_gain: must hold model.sensor_gain, 1; got 1.1 to 1.3",
        ),
        (SMALL + "    modulus_margin: 1.5\n", "design.robust.modulus_margin"),
        (SMALL.replace("functions: 16", "functions: 1000"), "functions must be at most 400"),
    ],
)
def test_a_bad_section_is_refused_with_its_key(small, tmp_path, capsys, section, message):
    gain = tmp_path / "none.fits"
    assert main(["design", small(section), "--method", "robust", "-o", str(gain)]) == 2
    assert message in capsys.readouterr().err
    assert not gain.exists()


@pytest.mark.parametrize(
    "option", [["--gamma", "3"], ["--horizon", "2"], ["--taps", "4"], ["--route", "lmi"]]
)
def test_options_of_other_methods_are_refused(small, tmp_path, capsys, option):
    argv = ["design", small(), "--method", "robust", *option, "-o", str(tmp_path / "x.fits")]
    assert main(argv) == 2
    assert option[0] in capsys.readouterr().err


def test_one_file_under_two_spellings_is_refused(small, tmp_path, capsys, monkeypatch):
    config = small()
    monkeypatch.chdir(tmp_path)
    assert main(["design", config, "--method", "robust", "-o", "one.fits"]) == 0
    assert main(["robustness", config, "one.fits", "./one.fits", "-o", "map.png"]) == 2
    assert "must be given once" in capsys.readouterr().err
