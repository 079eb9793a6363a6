"""A vibration that drifts: its frequency, its variance, and who refuses it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.signal import hilbert
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.interop.specula.json_cases import _build_vibration, make_case
from lbt_synth.loop.simulation.disturbances import draw_disturbance
from lbt_synth.models.truth import checked_direction

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def drifting(**changes):
    given = {"start_hz": 17, "end_hz": 23, "duration_s": 10, "rms_nm": 100, "direction": (1,)}
    return lbt.models.DriftingVibration(**(given | changes))


def drawn(line, *, frames, cases=1, zero_frame=0, seed=0):
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    rng = np.random.default_rng(seed)
    return draw_disturbance(
        truth, PATH, frames=frames, cases=cases, rng=rng, zero_frame=zero_frame
    )[..., 0]


def test_the_sinusoid_has_the_frequency_at_each_time():
    """By its analytic signal (Hilbert), and by counting zero crossings second by second."""
    line = drifting()
    (series,) = drawn(line, frames=14 * 800, zero_frame=1600)
    time_s = (np.arange(series.size) - 1600) / 800
    phase = np.unwrap(np.angle(hilbert(series)))
    found = np.gradient(phase, time_s) / (2 * np.pi)
    inside = slice(400, -400)  # the ends of a Hilbert transform are wrong
    assert np.max(np.abs(found - line.frequency_hz_at(time_s))[inside]) < 0.06
    assert np.abs(np.mean((found - line.frequency_hz_at(time_s))[inside])) < 1e-3
    for second in range(14):
        part = series[800 * second : 800 * (second + 1)]
        crossings = np.count_nonzero(np.diff(np.signbit(part)))
        middle = line.frequency_hz_at(second - 2 + 0.5)
        assert abs(crossings / 2 - middle) <= 1
    assert np.max(np.abs(series)) == pytest.approx(100 * np.sqrt(2), rel=1e-3)


def test_the_phase_is_the_integral_of_the_frequency():
    line = drifting(start_hz=23, end_hz=17, duration_s=3)
    time_s = np.linspace(-2, 5, 70_001)
    summed = np.concatenate(
        [[0], np.cumsum((line.frequency_hz_at(time_s)[1:] + line.frequency_hz_at(time_s)[:-1]) / 2)]
    ) * (time_s[1] - time_s[0])
    turns = line.turns_at(time_s)
    assert np.allclose(turns - turns[0], summed, atol=1e-8)
    assert line.turns_at(0.0) == 0


def test_without_a_drift_it_is_the_sinusoid_and_the_resonance():
    still = drifting(start_hz=20, end_hz=20)
    (series,) = drawn(still, frames=4000, zero_frame=321)
    plain = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100, direction=(1,))
    a, b = np.cos(2 * np.pi * 20 * np.arange(4000) / 800), np.sin(2 * np.pi * np.arange(4000) / 40)
    basis = np.stack([a, b], axis=1)
    left = series - basis @ np.linalg.lstsq(basis, series, rcond=None)[0]
    assert np.max(np.abs(left)) < 1e-8
    assert np.std(series) == pytest.approx(np.std(drawn(plain, frames=4000)), rel=1e-3)

    damped = drifting(start_hz=20, end_hz=20, damping=0.01)
    a1, a2, driving = damped.ar_process(np.arange(-5, 5) / 800, 800)
    model = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100).ar_model(800)
    assert np.allclose(a1, model.coefficients[0], rtol=1e-14)
    assert a2 == pytest.approx(model.coefficients[1], rel=1e-14)
    assert np.allclose(driving, model.driving_rms_nm, rtol=1e-9)


@given(
    start=st.floats(5, 60),
    end=st.floats(5, 60),
    duration=st.floats(2, 30),
    damping=st.floats(0.02, 0.3),
)
def test_the_variance_of_the_resonance_is_held_exactly(start, end, duration, damping):
    """Against the recursion of the covariance of two frames, whatever the drift."""
    line = drifting(
        start_hz=start, end_hz=max(end, 0.5 * start), duration_s=duration, damping=damping
    )
    time_s = (np.arange(600) - 100) / 800
    try:
        a1, a2, driving = line.ar_process(time_s, 800)
    except lbt.errors.ProblemError:
        assert end < start  # only a falling frequency pumps up the amplitude
        return
    together = a1[0] / (1 - a2)
    P = 100**2 * np.array([[1, together], [together, 1]])
    for k in range(len(time_s)):
        A = np.array([[a1[k], a2], [1, 0]])
        P = A @ P @ A.T
        P[0, 0] += driving[k] ** 2
        assert P[0, 0] == pytest.approx(100**2, rel=1e-8)


def test_the_drawn_resonance_has_its_rms_and_its_decay():
    line = drifting(duration_s=2, damping=0.02)
    series = drawn(line, frames=2800, cases=2000, zero_frame=400)
    for frame in (0, 1, 399, 1200, 2000, 2799):
        assert series[:, frame].std() == pytest.approx(100, rel=0.07)
    early, late = series[:, :2], series[:, 2400:2402]  # before the drift, and after it
    for pair, hz in ((early, 17), (late, 23)):
        model = (
            lbt.Vibration(frequency_hz=17, damping=0.02, rms_nm=100).at_frequency(hz).ar_model(800)
        )
        a1, a2 = model.coefficients
        correlation = np.mean(pair[:, 0] * pair[:, 1]) / np.mean(pair**2)
        assert correlation == pytest.approx(a1 / (1 - a2), abs=1.5e-3)


def test_time_0_is_the_first_kept_frame():
    plant = lbt_axis_plant()
    truth = lbt.Truth(turbulence=None, vibrations=(drifting(),), noise_nm=1)
    gentle = lbt.integrator(plant.hardware, gain=0.3).controller
    series = {
        settle: lbt.simulate(
            gentle, truth, hardware=plant.hardware, frames=4000, settle_frames=settle
        ).total_nm[0, :, 0]
        for settle in (0, 1000)
    }
    # the same phase at random but for the settling: the same frequencies in the same frames
    phases = [np.unwrap(np.angle(hilbert(s))) for s in series.values()]
    apart = np.diff(phases, axis=0)[0][300:-300]
    assert np.ptp(apart) < 0.05


def test_what_needs_a_stationary_truth_refuses_it(config):
    plant = lbt_axis_plant()
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=(drifting(),), noise_nm=15.5)
    design = lbt.kalman(plant)
    loop = lbt.close_loop(plant.hardware, design.controller)
    camera = lbt.Imaging(diameter_m=8.22)
    hw = plant.hardware
    for refused in (
        lambda: lbt.residual_budget(loop, truth),
        lambda: lbt.loop.least_residual(hw, truth),
        lambda: lbt.loop.least_worst_residual(
            hw, truth, band_hz=(15, 25), rms_nm=100, direction=(1,)
        ),
        lambda: lbt.studies.robustness_map(design, truth, camera, errors_hz=[0], sensor_gains=[1]),
        lambda: lbt.studies.limits({"kalman": design}, hw, truth, camera),
        lambda: list(lbt.studies.robustness(plant, truth, camera, errors_hz=[0])),
        lambda: lbt.design.optimal_integrator(hw, truth),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="drifts from 17 to 23 Hz. Simulate it"):
            refused()


def test_wrong_drifts_are_refused():
    for wrong, words in (
        ({"start_hz": 0}, "start_hz must be above 0"),
        ({"end_hz": -1}, "end_hz must be above 0"),
        ({"duration_s": 0}, "duration_s must be above 0"),
        ({"rms_nm": float("nan")}, "rms_nm must be finite"),
        ({"damping": 1.0}, "damping must be below 1"),
        ({"direction": (0,)}, "direction must be a vector"),
        ({"damping": 0.5, "end_hz": 8}, "frequency above that"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            drifting(**wrong)
    with pytest.raises(lbt.errors.ProblemError, match="time_s must be finite"):
        drifting().frequency_hz_at(np.nan)
    with pytest.raises(lbt.errors.ProblemError, match="a sinusoid has no AR2 process"):
        drifting().ar_process(np.arange(3) / 800, 800)
    falls = drifting(start_hz=23, end_hz=10, duration_s=0.5, damping=1e-4)
    with pytest.raises(lbt.errors.ProblemError, match="must move slowly beside its decay"):
        drawn(falls, frames=800)
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 500 Hz"
    ):
        checked_direction(drifting(end_hz=500), PATH)
    with pytest.raises(lbt.errors.DimensionError, match="must have 1 components"):
        checked_direction(drifting(direction=(1, 0)), PATH)


# --------------------------------------------------------------------------
# In a configuration, and at the command line.
# --------------------------------------------------------------------------
def drift_file(tmp_path, keys="kind: drift\n      end_hz: 23\n      duration_s: 60"):
    """examples/lbt.yaml with another true vibration."""
    yaml = YAML()
    settings = yaml.load(LBT_YAML.read_text())
    entry = f"a:\n    - axis: tip\n      frequency_hz: 17\n      rms_nm: 797\n      {keys}\n"
    settings["truth"]["vibrations"] = yaml.load(entry)["a"]
    settings["simulation"] = {"frames": 2000, "cases": 1, "settle_frames": 500}
    path = tmp_path / "drift.yaml"
    with path.open("w") as file:
        yaml.dump(settings, file)
    return path


def test_a_configuration_may_have_one(tmp_path):
    (found,) = lbt.load_config(drift_file(tmp_path)).truth.vibrations
    expected = lbt.models.DriftingVibration(start_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    assert found == expected
    damped = "kind: drift\n      end_hz: 16\n      duration_s: 9\n      damping: 0.01"
    (found,) = lbt.load_config(drift_file(tmp_path, damped)).truth.vibrations
    assert (found.damping, found.end_hz, found.duration_s) == (0.01, 16, 9)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("kind: drift", "end_hz and duration_s go with kind: drift"),
        ("kind: drift\n      end_hz: 23", "end_hz and duration_s go with kind: drift"),
        ("kind: sinusoid\n      end_hz: 23", "end_hz and duration_s go with kind: drift"),
        ("kind: sinusoid\n      damping: 0.1", "damping goes with kind: resonance"),
        ("kind: drift\n      end_hz: 500\n      duration_s: 60", r"\[0\].end_hz: must lie below"),
        ("kind: drift\n      end_hz: -3\n      duration_s: 60", "greater than 0"),
        (
            "kind: drift\n      end_hz: 2\n      duration_s: 60\n      damping: 0.5",
            r"truth.vibrations\[0\]: .* frequency above that",
        ),
    ],
)
def test_wrong_keys_are_refused(tmp_path, keys, words):
    with pytest.raises(lbt.errors.ConfigError, match=words):
        lbt.load_config(drift_file(tmp_path, keys))


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


def test_a_case_of_an_end_to_end_run_keeps_it():
    setup = lbt.load_config(LBT_YAML).end_to_end
    line = drifting(direction=(1, 0), damping=0.01)
    case = json.loads(json.dumps(make_case(setup, None, vibrations=[line])))
    assert _build_vibration(case["vibrations"][0]) == line
