"""The commands design, show and verify."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import run, run_done, run_json
from support.configs import write_config
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli.design import add_moving_gains, describe_design
from lbt_synth.cli.output import Report
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.interop.c.export import frame_cost


def described(design):
    report = Report()
    describe_design(report, design)
    return " ".join(report.verdict), " ".join(report.notes)


def test_a_fragile_design_does_not_pass_without_a_word(tmp_path):
    half = LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.5")
    plant = lbt.load_config(write_config(tmp_path, half)).plant
    gain = 0.99 * lbt.design.integrator_gain_limit(plant.hardware)
    # the image does not pay for commands that alternate
    designs = lbt.kalman(plant), lbt.lqg(plant), lbt.integrator(plant.hardware, gain=gain)
    *others, fragile = (described(design)[0] for design in designs)
    assert "make this loop unstable" not in " ".join(others)
    assert re.match(r"0\.0\d+ frames \(\S+ us\) more delay make this loop unstable", fragile)
    slow = lbt.load_config(ROOT / "examples" / "lbt_slow_mirror.yaml")
    assert "as if the mirror settled at once" in described(lbt.kalman(slow.plant))[1]


@pytest.mark.parametrize("late", [0.0, np.inf])
def test_the_time_of_a_fragile_delay_needs_no_margin_on_the_other_side(monkeypatch, late):
    def fragile(loop):
        return replace(lbt.loop_margins(loop), delay_frames=late, early_frames=0.04)

    monkeypatch.setattr("lbt_synth.cli.design.loop_margins", fragile)
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000, modes=1), gain=0.5)
    assert "0.04 frames (40 us) less delay make this loop unstable" in described(design)[0]


def test_show_and_verify(capsys, gains):
    for name in ("integrator", "kalman"):
        words, design = ("show", gains[name]), lbt.load_gain(gains[name])
        text, data = run_done(capsys, *words, "--verbose"), run_json(capsys, *words)
        cost, moving = frame_cost(design), data["moving_gain"]
        assert re.search(rf"multiplications per frame +{cost.multiplications}\b", text)
        assert "proved while it moves at any speed, from" in text
        assert "proved in the plain form, up to" in text
        assert data["frame_cost"]["additions"] == cost.additions
        assert data["margins"]["modulus"] > 0
        assert moving["constant_low"] < moving["moving_low"] < 1
        assert 1 < moving["moving_high"] < moving["constant_high"]
        forms = {"plain": design, "estimator": lbt.linear.estimator_form(design)}
        ratios = {form: lbt.loop.stroke_ratio(design.hardware, law) for form, law in forms.items()}
        assert data["clipped_commands"] == pytest.approx(ratios)
        assert (1 < ratios["plain"] < 20) == (name == "kalman")
        assert data["digest"] == load_with_digest(gains[name])[1]


def test_a_controller_without_an_estimator_form_has_no_number_for_it():
    zeros = {"A": [[0, 0], [1, 0]], "B": [[1], [0]], "C": [[0.05, 0.1]], "D": 0.0}  # at z = -2
    law = lbt.Controller(**zeros, dt_s=1 / 800)
    hardware = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    design = SimpleNamespace(hardware=hardware, controller=law, other_sensors=())
    report = Report()
    add_moving_gains(report, design)
    assert report.data["clipped_commands"] == {"plain": 1e4, "estimator": None}


def test_verification_that_fails_has_status_1(capsys, monkeypatch, gains):
    honest = lbt.Design.recertify

    def strict(self):
        certificate = honest(self)
        checks = tuple(replace(c, value=c.limit + 1) for c in certificate.checks)
        return replace(certificate, checks=checks)

    monkeypatch.setattr(type(lbt.load_gain(gains["kalman"])), "recertify", strict)
    status, text, _ = run(capsys, "verify", gains["kalman"])
    assert (status, "NOT VERIFIED" in text) == (1, True)
