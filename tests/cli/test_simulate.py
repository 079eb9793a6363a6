"""The command simulate, with one sensor and with several that may fail."""

import re
from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from support.commands import run_done, run_json
from support.configs import write_config
from support.drifting import drift_file
from support.plants import LBT_YAML
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.studies.runs import tiptop_spectrum


def test_simulate(tmp_path, capsys, gains):
    """A line for each gain file, as it would be alone: one seed is one weather."""
    out, few = tmp_path / "run.png", ("--frames", 1000, "--cases", 2)
    (row, *others) = run_json(capsys, "simulate", LBT_YAML, *gains.values(), *few)["designs"]
    assert [each["design"] for each in (row, *others)] == list(gains)
    words = ("simulate", LBT_YAML, gains["kalman"], *few)
    assert run_json(capsys, *words, "-o", out)["designs"] == [row]
    assert (out.exists(), len(row["cases_strehl"])) == (True, 2)
    dim = run_json(capsys, *words, "--sensor-gain", 0.4)
    assert dim["sensor_gain"] == 0.4
    assert (
        dim["designs"][0]["strehl_exact"] < row["strehl_exact"] == pytest.approx(0.827, abs=0.002)
    )


def test_the_spectrum_is_what_tiptop_reads(tmp_path, capsys, gains):
    """By the formulas of its packages: MASTSEL 1.5.4, loadWindPsd; P3 1.6.4, windShakePSD."""
    out = tmp_path / "residual.fits"
    words = ("simulate", LBT_YAML, gains["kalman"], "--frames", 50, "--spectrum", out)
    data = run_json(capsys, *words)
    assert data["files"] == [str(out)]
    residual_nm = pytest.approx(data["designs"][0]["residual_exact_nm"], rel=1e-4)
    with fits.open(out, checksum=True) as units:
        rows = units[0].data
        assert (units[0].header["BUNIT"], rows.shape) == ("nm^2/Hz", (3, 2001))
    for first_hz, points in ((0.2, 5 * 400), (0.1, 5 * 800)):
        frequency_hz = np.linspace(first_hz, 400, points)
        tip, tilt = (np.interp(frequency_hz, rows[0], row, left=0, right=0) for row in rows[1:])
        power = np.sum(tip + tilt) * (frequency_hz[1] - frequency_hz[0])
        assert np.sqrt(power) == residual_nm
    assert np.sqrt(np.trapezoid(rows[1:], rows[0]).sum()) == residual_nm
    path = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    spectrum = partial(tiptop_spectrum, loop, lbt.Truth(turbulence=None, noise_nm=1.0))
    refused(spectrum, ProblemError, "takes a loop of tip and tilt; got 3 modes")


def test_a_mirror_of_little_stroke(capsys, gains):
    words = ("simulate", LBT_YAML, gains["kalman"], "--frames", 500, "--cases", 1)
    (free,) = run_json(capsys, *words)["designs"]
    left = {}
    for form in ("plain", "estimator"):
        (row,) = run_json(capsys, *words, "--stroke", 1200, "--form", form)["designs"]
        left[form] = row["residual_simulated_nm"], row["clipped"]
    assert left["plain"] > left["estimator"] > (free["residual_simulated_nm"], 0)
    assert left["plain"][1] > left["estimator"][1] > 0


def test_the_commands_simulate_it_or_refuse(tmp_path, capsys):
    """A vibration that drifts."""
    config, gain = drift_file(tmp_path), tmp_path / "kalman.fits"
    text = run_done(capsys, "design", config, "--method", "kalman", "-o", gain)
    assert "a vibration of the truth drifts" in " ".join(text.split())
    (row,) = run_json(capsys, "simulate", config, gain)["designs"]
    assert row["strehl_exact"] is None
    assert 0 < row["cases_strehl"][0] < 1


def test_sensors_that_fail_on_the_way(tmp_path, capsys, sensors_config, sensors_file):
    drops = ("--drop", "m2@0.2s", "--drop", "wavefront@0.5s..0.7s:frozen", "--cases", 1)
    words = ("simulate", sensors_config.source, sensors_file, *drops)
    data = run_json(capsys, *words)
    assert data["frames"] == 5700
    sensors = ["none", "m2", "m2, wavefront (frozen)", "m2"]
    assert [row["sensors"] for row in data["segments"]] == sensors
    text = run_done(capsys, *words, "--frames", 1000, "-o", tmp_path / "drops.png")
    assert "Simulated between failures and returns" in text
    assert (tmp_path / "drops.png").stat().st_size > 10_000


def test_what_shows_a_design_of_several_sensors(tmp_path, capsys, sensors_config, sensors_file):
    text = run_done(capsys, "show", sensors_file, "--verbose")
    for words in ("When sensors fail", "wavefront + slow + m1 + m2", "own sensor in the truth"):
        assert words in text
    assert "verified" in run_done(capsys, "verify", sensors_file)
    text = run_done(capsys, "limits", sensors_config.source, sensors_file)
    assert re.search(r"^ +sensors +37\.40 ", text, re.MULTILINE)
    beside = "runs with the sensors of the gain file beside the loop's own"
    assert beside not in text
    source = sensors_config.source.read_text()
    noisy = source.replace("noise_m_s2: 2.0e-4", "noise_m_s2: 2.0e-2")
    words = ("simulate", write_config(tmp_path, noisy), sensors_file, "--frames", 500)
    assert beside in run_done(capsys, *words)  # other sensors than those of the configuration
    text = run_done(capsys, "tradeoff", sensors_config.source, "--points", 2, "--taps", 2)
    assert "note: the loop's own sensor is read alone, without slow, m1, m2." in text
