"""The robust design from a configuration: the command line, and the example it ships with."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.config.robust import robust_design

EXAMPLE = Path("examples/lbt_robust.yaml")
SMALL = """
  robust:
    turbulence: model
    bands:
      - {low_hz: 19.0, high_hz: 21.0, rms_mas: 10.0}
    functions: 16
    states: null
"""


@pytest.fixture
def small(tmp_path):
    text = EXAMPLE.read_text()
    start, end = text.index("design:"), text.index("simulation:")
    path = tmp_path / "small.yaml"

    def write(section=SMALL, **changes):
        out = text[:start] + "design:" + section + "\n" + text[end:]
        for old, new in changes.values():
            assert old in out
            out = out.replace(old, new)
        path.write_text(out)
        return str(path)

    return write


# -- the example: the numbers that it promises -----------------------------------------------
@pytest.fixture(scope="module")
def example():
    return robust_design(lbt.load_config(EXAMPLE))


def test_the_example_holds_at_every_row_and_sensor_gain(example):
    config = lbt.load_config(EXAMPLE)
    camera = replace(config.imaging, other_modes=0.841)
    noise = replace(config.truth, noise_nm=15.5)
    found = lbt.studies.robustness_map(
        example, noise, camera, errors_hz=np.arange(-7, 8) / 2, sensor_gains=[1, 0.7, 0.5, 0.358]
    )
    worst = 100 * np.min(found.strehl[0], axis=1)
    assert np.all(worst >= [83, 82.5, 82, 80.5])
    assert np.all(worst <= 84.1)


def test_the_example_is_stable_over_its_interval_with_its_margin_and_few_states(example):
    hardware = example.hardware
    low, high = lbt.loop.stable_sensor_gains(hardware, example.controller)
    assert low < 0.25
    assert high > 1.3
    assert lbt.loop_margins(lbt.close_loop(hardware, example.controller)).modulus >= 0.45
    assert example.states_per_mode <= 20
    assert example.controller.n_states == 2 * example.states_per_mode
    assert 0 < example.loss <= 0.25


def test_the_example_simulates_as_it_is_computed(example):
    config = lbt.load_config(EXAMPLE)
    truth = replace(config.truth, sensor_gain=0.5)
    exact = lbt.strehl(
        lbt.residual_budget(
            lbt.close_loop(config.hardware, example.controller, sensor_gain=0.5), truth
        ),
        config.imaging,
    )
    run = lbt.simulate(
        example.controller, truth, hardware=config.hardware, frames=8000, cases=2, seed=3
    )
    assert np.mean(run.strehl(config.imaging)) == pytest.approx(exact, abs=0.004)


# -- the command line ----------------------------------------------------------------------------
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


def test_sensor_gains_of_the_file_are_real_ones(small):
    plain = robust_design(lbt.load_config(small()))
    believed = {"a": ("    kind: ar2", "    kind: ar2\n  sensor_gain: 0.5")}
    section = SMALL + "    sensor_gain: [0.3, 0.8]\n    scenarios: [0.5]\n"
    design = robust_design(lbt.load_config(small(section, **believed)))
    assert plain.specifications[0].objective.terms[0].sensor_gain == 1
    labels = [d.label for d in design.specifications[0].demands]
    assert "stability for sensor gains 0.6 to 1.6" in labels
    noise = [d.specifications[0].objective.terms[0].noise_nm for d in (plain, design)]
    assert noise[1] == pytest.approx(2 * noise[0])


def test_every_demand_of_the_file_reaches_the_specification(small):
    section = (
        SMALL
        + """    noise_peak: 3.0
    delay_error_frames: 0.2
    command_stroke_nm: 900.0
    command_step_nm: 200.0
    attenuation:
      - {low_hz: 0.0, high_hz: 1.0, at_most: 0.2}
    mirror_uncertainty:
      - {relative: 0.2, low_hz: 200.0, high_hz: 400.0}
"""
    )
    design = robust_design(lbt.load_config(small(section)))
    kinds = [type(d).__name__ for d in design.specifications[0].demands]
    assert kinds == [
        "ModulusMargin",
        "NoisePeak",
        "DelayError",
        "Attenuation",
        "MirrorUncertainty",
        "CommandRms",
        "CommandRms",
    ]


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
