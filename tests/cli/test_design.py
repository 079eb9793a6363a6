"""The commands design, show and verify."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.exports import lbt_config, turn_states
from support.plants import LBT_YAML, ROOT, lbt_axis_plant
from support.robust_config import SMALL, robust_writer

import lbt_synth as lbt
from lbt_synth.cli.design import describe_design
from lbt_synth.cli.main import main
from lbt_synth.cli.output import Report
from lbt_synth.files.gain_file.store import load_with_digest

CONFIG = str(LBT_YAML)


@pytest.mark.parametrize(
    ("options", "method"),
    [
        (("--method", "kalman"), "kalman"),
        (("--method", "kalman", "--route", "sdp"), "kalman"),
        (("--method", "hinf", "--gamma-ratio", 1.2), "hinf"),
        (("--method", "hinf", "--gamma", 200, "--route", "riccati"), "hinf"),
        (("--method", "integrator"), "integrator"),
        (("--method", "integrator", "--gain", 0.4), "integrator"),
    ],
)
def test_design(tmp_path, capsys, options, method):
    out = tmp_path / "g.fits"
    status, text, error = run(capsys, "design", CONFIG, *options, "-o", out)
    assert (status, error) == (0, "")
    assert lbt.load_gain(out).method == method
    assert re.search(r"(\d+) of \1 checks passed\.", " ".join(text.split()))


def test_default_ratio_comes_from_the_configuration(tmp_path, capsys):
    status, text, _ = run(
        capsys, "design", CONFIG, "--method", "hinf", "-o", tmp_path / "g.npz", "--json"
    )
    data = json.loads(text)
    assert status == 0
    assert data["gamma_requested"] / data["gamma_least"] == pytest.approx(1.2)
    assert data["gamma"] <= data["gamma_requested"]


def test_a_small_margin_gets_a_note(tmp_path, capsys):
    _, out, _ = run(capsys, "design", CONFIG, "--method", "integrator", "-o", tmp_path / "i.fits")
    assert "note: the modulus margin 0.0751 is small" in out


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def ends(plant):
    return lbt.hinf(plant, route="riccati"), lbt.kalman(plant)


def test_bounds_without_a_limit(plant, ends, tmp_path, capsys):
    assert lbt.mixed(plant, gamma_ratio=1e300 / ends[0].gamma_least).rms == ends[1].rms
    assert lbt.mixed(plant, rms=1e200).gamma == ends[0].gamma
    target = str(tmp_path / "m.npz")
    for size in ("1e30", "1e200"):
        assert (
            main(["design", str(LBT_YAML), "--method", "mixed", "--rms", size, "-o", target]) == 0
        )
    capsys.readouterr()


@pytest.fixture
def small(tmp_path):
    return robust_writer(tmp_path)


def test_design_show_verify_sigma_and_simulate_take_a_robust_design(small, tmp_path, capsys):
    gain, picture = str(tmp_path / "robust.fits"), str(tmp_path / "sigma.png")
    config = small()
    assert main(["design", config, "--method", "robust", "-o", gain]) == 0
    capsys.readouterr()
    assert main(["show", gain, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["method"] == "robust"
    assert shown["above_limit_percent"] > 0
    assert shown["limit_nm"] < shown["objective_nm"][0] * np.sqrt(2)
    assert len(shown["terms"]) == 4
    assert main(["verify", gain]) == 0
    assert main(["plot", "sigma", gain, "-o", picture]) == 0
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
            "design.robust: a band must lie below the Nyquist frequency 400 Hz; got 3 to 600 Hz",
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


SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


def test_a_filter_that_ignores_the_dynamics_says_so(tmp_path, capsys):
    gain = str(tmp_path / "kalman.npz")
    assert main(["design", str(SLOW_YAML), "--method", "kalman", "-o", gain]) == 0
    assert "as if the mirror settled at once" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("method", "option", "value", "text"),
    [
        (
            "kalman",
            "--gamma",
            "200",
            "--gamma goes with --method hinf or mixed; got --method kalman",
        ),
        ("kalman", "--taps", "3", "--taps goes with --method mixed; got --method kalman"),
        (
            "mixed",
            "--route",
            "lmi",
            "--route goes with --method hinf or kalman; got --method mixed",
        ),
    ],
)
def test_an_option_of_another_method_is_refused(tmp_path, capsys, method, option, value, text):
    target = str(tmp_path / "p.fits")
    assert main(["design", CONFIG, "--method", method, option, value, "-o", target]) == 2
    assert text in capsys.readouterr().err


def test_a_fragile_design_does_not_pass_without_a_word(tmp_path, capsys):
    config, gain = tmp_path / "half.yaml", tmp_path / "g.fits"
    config.write_text(LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.5"))
    for method in ("kalman", "lqg"):  # the image does not pay for commands that alternate
        status, out, _ = run(capsys, "design", config, "--method", method, "-o", gain)
        assert status == 0
        assert "make this loop unstable" not in " ".join(out.split())
    plant = lbt.load_config(config).plant
    late = lbt.integrator(plant.hardware, gain=0.99 * lbt.design.integrator_gain_limit(2.5))
    warned = run(capsys, "show", lbt.save_gain(gain, late))[1]
    assert re.match(r"0\.0\d+ frames \(\S+ us\) more delay make this loop unstable", warned)
    status, out, _ = run(capsys, "design", LBT_YAML, "--method", "integrator", "-o", gain)
    assert out.startswith("A sensor gain that is off by 0.78 dB makes this loop unstable.")


@pytest.mark.parametrize("late", [0.0, np.inf])
def test_the_time_of_a_fragile_delay_needs_no_margin_on_the_other_side(monkeypatch, late):
    def fragile(loop):
        return replace(lbt.loop_margins(loop), delay_frames=late, delay_s=late, early_frames=0.04)

    monkeypatch.setattr("lbt_synth.cli.design.loop_margins", fragile)
    hardware = lbt.LoopHardware(frame_rate_hz=1000, modes=1)
    report = Report()
    describe_design(report, lbt.integrator(hardware, gain=0.5))
    assert "0.04 frames (40 us) less delay make this loop unstable" in " ".join(report.verdict)


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_show_and_verify(capsys, gains, name):
    status, text, _ = run(capsys, "show", gains[name], "--matrices", "--verbose")
    assert status == 0
    assert "stable gain factors, from" in text
    lines = text.splitlines()
    assert lines[lines.index("A =") + 1].startswith("[[")
    assert lines[lines.index("D =") + 2].startswith(" [0.")
    status, text, _ = run(capsys, "show", gains[name], "--json", "--matrices")
    data = json.loads(text)
    assert status == 0
    assert data["margins"]["modulus"] > 0
    status, text, _ = run(capsys, "verify", gains[name])
    assert status == 0
    assert "verified" in text
    assert json.loads(run(capsys, "verify", gains[name], "--json")[1])["passed"] is True


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_show_prints_the_cost(tmp_path, capsys, monkeypatch, name):
    design = kalman = lbt.kalman(lbt_config().plant)
    if name == "turned":
        spread = lbt.models.spread_plant(lbt_config().plant, half_width_hz=3.5, lines=3)
        design = turn_states(lbt.kalman(spread))
    gain = lbt.save_gain(tmp_path / "kalman.fits", kalman)
    monkeypatch.setattr("lbt_synth.cli.design.load_with_digest", lambda path: (design, "0"))
    cost = lbt.interop.frame_cost(design)
    status, text, _ = run(capsys, "show", gain, "--verbose")
    assert status == 0
    assert re.search(rf"multiplications per frame +{cost.multiplications}\b", text)
    assert re.search(rf"coefficients +{cost.coefficients}\b", text)
    data = json.loads(run(capsys, "show", gain, "--json")[1])["frame_cost"]
    assert data["additions"] == cost.additions


def test_show_says_what_is_only_the_files_word(tmp_path, capsys):
    config = lbt.load_config(LBT_YAML)
    bare = lbt.integrator(config.hardware, gain=0.4)
    for design, more in ((bare, ""), (config.design("integrator", gain=0.4), "; configuration")):
        path = lbt.save_gain(tmp_path / "i.npz", design)
        status, text, _ = run(capsys, "show", path, "--verbose")
        assert status == 0
        assert f"not proved, the file's word: route and status of the solver{more}" in text
        assert f"digest {load_with_digest(path)[1]}" in text


@pytest.mark.parametrize("command", ["show", "verify"])
def test_intervals_of_a_gain_that_moves(capsys, gains, command):
    _, text, _ = run(capsys, command, gains["kalman"], "--verbose")
    assert "proved while it moves at any speed, from" in text
    _, text, _ = run(capsys, command, gains["kalman"], "--json")
    moving = json.loads(text)["moving_gain"]
    assert moving["constant_low"] < moving["moving_low"] < 1
    assert 1 < moving["moving_high"] < moving["constant_high"]


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
