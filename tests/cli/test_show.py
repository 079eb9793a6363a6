"""The commands show and verify."""

import json
import re

import pytest
from support.commands import run
from support.exports import lbt_config, turn_states
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.files.gain_file.store import load_with_digest


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_show_and_verify(capsys, gains, name):
    status, text, _ = run(capsys, "show", gains[name], "--matrices")
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
    monkeypatch.setattr("lbt_synth.cli.show.load_with_digest", lambda path: (design, "0"))
    cost = lbt.interop.frame_cost(design)
    status, text, _ = run(capsys, "show", gain)
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
        status, text, _ = run(capsys, "show", path)
        assert status == 0
        assert f"not proved, the file's word: route and status of the solver{more}" in text
        assert f"digest {load_with_digest(path)[1]}" in text


@pytest.mark.parametrize("command", ["show", "verify"])
def test_intervals_of_a_gain_that_moves(capsys, gains, command):
    _, text, _ = run(capsys, command, gains["kalman"])
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
