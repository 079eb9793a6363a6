"""The commands design, show and verify."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import run
from support.exports import lbt_config, turn_states
from support.plants import LBT_YAML, ROOT
from support.robust_config import robust_writer

import lbt_synth as lbt
from lbt_synth.cli.design import add_moving_gains, describe_design
from lbt_synth.cli.main import main
from lbt_synth.cli.output import Report
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.interop.c.export import frame_cost

CONFIG = str(LBT_YAML)


@pytest.mark.parametrize(
    ("options", "method"),
    [
        (("--method", "kalman"), "kalman"),
        (("--method", "hinf", "--gamma", 200, "--route", "riccati"), "hinf"),
        (("--method", "integrator"), "integrator"),
    ],
)
def test_design(tmp_path, capsys, options, method):
    out = tmp_path / "g.fits"
    status, text, error = run(capsys, "design", CONFIG, *options, "-o", out)
    assert (status, error) == (0, "")
    assert lbt.load_gain(out).method == method
    assert re.search(r"(\d+) of \1 checks passed\.", " ".join(text.split()))


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
    assert shown["loss"] < 0.1
    assert len(shown["terms"]) == 4
    assert main(["verify", gain]) == 0
    assert main(["plot", "sigma", gain, "-o", picture]) == 0
    assert Path(picture).stat().st_size > 10_000
    assert main(["simulate", config, gain, "--frames", "500", "--cases", "1"]) == 0
    assert "Strehl ratio" in capsys.readouterr().out


SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


def test_a_filter_that_ignores_the_dynamics_says_so(tmp_path, capsys):
    gain = str(tmp_path / "kalman.npz")
    assert main(["design", str(SLOW_YAML), "--method", "kalman", "-o", gain]) == 0
    assert "as if the mirror settled at once" in capsys.readouterr().out


def test_a_fragile_design_does_not_pass_without_a_word(tmp_path, capsys):
    config, gain = tmp_path / "half.yaml", tmp_path / "g.fits"
    config.write_text(LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.5"))
    for method in ("kalman", "lqg"):  # the image does not pay for commands that alternate
        status, out, _ = run(capsys, "design", config, "--method", method, "-o", gain)
        assert status == 0
        assert "make this loop unstable" not in " ".join(out.split())
    plant = lbt.load_config(config).plant
    late = lbt.integrator(
        plant.hardware, gain=0.99 * lbt.design.integrator_gain_limit(plant.hardware)
    )
    warned = run(capsys, "show", lbt.save_gain(gain, late))[1]
    assert re.match(r"0\.0\d+ frames \(\S+ us\) more delay make this loop unstable", warned)
    status, out, _ = run(capsys, "design", LBT_YAML, "--method", "integrator", "-o", gain)
    assert out.startswith("A sensor gain that is off by 0.78 dB makes this loop unstable.")


@pytest.mark.parametrize("late", [0.0, np.inf])
def test_the_time_of_a_fragile_delay_needs_no_margin_on_the_other_side(monkeypatch, late):
    def fragile(loop):
        return replace(lbt.loop_margins(loop), delay_frames=late, early_frames=0.04)

    monkeypatch.setattr("lbt_synth.cli.design.loop_margins", fragile)
    hardware = lbt.LoopHardware(frame_rate_hz=1000, modes=1)
    report = Report()
    describe_design(report, lbt.integrator(hardware, gain=0.5))
    assert "0.04 frames (40 us) less delay make this loop unstable" in " ".join(report.verdict)


@pytest.mark.parametrize("name", ["kalman", "integrator"])
def test_show_and_verify(capsys, gains, name):
    status, text, _ = run(capsys, "show", gains[name], "--verbose")
    assert status == 0
    assert "stable gain factors, from" in text
    assert "proved while it moves at any speed, from" in text
    assert "proved in the plain form, up to" in text
    status, text, _ = run(capsys, "show", gains[name], "--json")
    data = json.loads(text)
    assert status == 0
    assert data["margins"]["modulus"] > 0
    moving = data["moving_gain"]
    assert moving["constant_low"] < moving["moving_low"] < 1
    assert 1 < moving["moving_high"] < moving["constant_high"]
    design = lbt.load_gain(gains[name])
    forms = {"plain": design, "estimator": lbt.linear.estimator_form(design)}
    ratios = {form: lbt.loop.stroke_ratio(design.hardware, law) for form, law in forms.items()}
    assert data["clipped_commands"] == pytest.approx(ratios)
    assert (1 < ratios["plain"] < 20) == (name == "kalman")
    assert data["digest"] == load_with_digest(gains[name])[1]
    status, text, _ = run(capsys, "verify", gains[name])
    assert status == 0
    assert "verified" in text
    assert json.loads(run(capsys, "verify", gains[name], "--json")[1])["passed"] is True


def test_a_controller_without_an_estimator_form_has_no_number_for_it():
    zeros = {"A": [[0, 0], [1, 0]], "B": [[1], [0]], "C": [[0.05, 0.1]], "D": 0.0}  # at z = -2
    law = lbt.Controller(**zeros, dt_s=1 / 800)
    hardware = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    design = SimpleNamespace(hardware=hardware, controller=law, other_sensors=())
    report = Report()
    add_moving_gains(report, design)
    assert report.data["clipped_commands"] == {"plain": 1e4, "estimator": None}


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_show_prints_the_cost(tmp_path, capsys, monkeypatch, name):
    design = kalman = lbt.kalman(lbt_config().plant)
    if name == "turned":
        spread = lbt.models.spread_plant(lbt_config().plant, half_width_hz=3.5, lines=3)
        design = turn_states(lbt.kalman(spread))
    gain = lbt.save_gain(tmp_path / "kalman.fits", kalman)
    monkeypatch.setattr("lbt_synth.cli.design.load_with_digest", lambda path: (design, "0"))
    cost = frame_cost(design)
    status, text, _ = run(capsys, "show", gain, "--verbose")
    assert status == 0
    assert re.search(rf"multiplications per frame +{cost.multiplications}\b", text)
    data = json.loads(run(capsys, "show", gain, "--json")[1])["frame_cost"]
    assert data["additions"] == cost.additions


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
