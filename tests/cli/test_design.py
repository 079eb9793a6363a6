"""The command design."""

from __future__ import annotations

import json

import pytest
from support.commands import run
from support.plants import LBT_YAML

import lbt_synth as lbt

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
    assert "Certificate" in text
    assert "modulus margin" in text


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
