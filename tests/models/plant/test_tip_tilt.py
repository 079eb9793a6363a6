"""The paper's state, entry by entry, and the equivalence of the two forms."""

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.models import ARModel
from lbt_synth.models.plant.tip_tilt import retuned_plant

RATE = 800
LINE = lbt.Vibration(frequency_hz=9, damping=0.1, rms_nm=1)


def slow(pole=0.98, drive=50.0):
    return ARModel(coefficients=[pole], driving_rms_nm=drive, frame_rate_hz=800)


@pytest.mark.parametrize(
    ("delay", "coefficients", "commands"), [(1, [0.99], 2), (2, [1.95, -0.955], 5), (4, [0.99], 2)]
)
def test_predicted_error_is_the_closed_loops_residual(delay, coefficients, commands):
    """Where truth is the model, the filter's rms is the residual of the loop, exactly."""
    turbulence = ARModel(coefficients=coefficients, driving_rms_nm=20, frame_rate_hz=800)
    line = lbt.Vibration(frequency_hz=23, damping=0.02, rms_nm=120, direction=(0.6, 0.8))
    rng = np.random.default_rng(3)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        delay_frames=delay,
        turbulence=turbulence,
        vibrations=[line],
        noise_nm=9.0,
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=rng.standard_normal((2, commands)),
    )
    design = lbt.kalman(plant)
    assert len(design.controller.C) == commands
    truth = lbt.Truth(turbulence=turbulence, vibrations=(line,), noise_nm=9.0)
    loop = lbt.close_loop(plant.hardware, design.controller)
    budget = lbt.residual_budget(loop, truth, frame_means=True)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_sensor_gain_of_the_design_is_undone():
    """A loop that is designed for sensor gain 0.5 behaves like the unit one at half the noise."""
    parts = {"frame_rate_hz": 800, "turbulence": slow()}
    halved = lbt.kalman(lbt.tip_tilt_plant(**parts, noise_nm=2.0, sensor_gain=0.5))
    unit = lbt.kalman(lbt.tip_tilt_plant(**parts, noise_nm=4.0))
    assert halved.rms == pytest.approx(unit.rms, rel=1e-12)
    assert np.allclose(0.5 * halved.gain_predictor, unit.gain_predictor, rtol=1e-10)
    covariance = np.array([[9.0, 2.0], [2.0, 4.0]])
    assert np.allclose(lbt.tip_tilt_plant(**parts, noise_nm=covariance).R, covariance)


def test_retuning_moves_only_the_vibration():
    plant = lbt_axis_plant()
    moved = retuned_plant(plant, 1.5, hold="rms")
    assert moved.vibrations[0].frequency_hz == 21.5
    back = retuned_plant(moved, -1.5)
    for name in "ABCDL":
        assert np.allclose(getattr(back, name), getattr(plant, name), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"noise_nm": 0.0}, "noise_nm must be above 0"),
        ({"noise_nm": [[1.0, 2.0], [0.0, 1.0]]}, "noise_nm must be symmetric"),
        ({"noise_nm": [[1.0, 2.0], [2.0, 1.0]]}, "noise_nm must be positive definite"),
        ({"noise_nm": np.eye(3)}, "to match the measurements"),
        ({"delay_frames": 20.5}, "delay_frames must be at most 20; got 20.5"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        ({"sensor_matrix": np.eye(3), "influence_matrix": np.eye(2)}, "to match sensor_matrix"),
        ({"sensor_matrix": [[np.nan, 0], [0, 1]]}, "sensor_matrix must be finite"),
        ({"turbulence": [slow()] * 3}, r"one per mode \(2\); got 3"),
        (
            {"turbulence": replace(slow(), frame_rate_hz=500)},
            "must be sampled at the loop's 800 Hz",
        ),
        ({"vibrations": [replace(LINE, direction=(1,))]}, "must have 2 components"),
        ({"vibrations": [replace(LINE, frequency_hz=450)]}, "below the Nyquist"),
    ],
)
def test_wrong_parts_are_refused(change, text):
    parts = {"frame_rate_hz": 800, "turbulence": slow(), "noise_nm": 2.0} | change
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.tip_tilt_plant(**parts)


def test_full_form_is_the_papers():
    """Two modes, one vibration on each: 2p + 2n + m = 10, equations 5 to 7."""
    lines = [
        lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=500, direction=(1, 0)),
        lbt.Vibration(frequency_hz=27, damping=0.02, rms_nm=300, direction=(0, 1)),
    ]
    rng = np.random.default_rng(1)
    sensor, influence = rng.standard_normal((3, 2)), rng.standard_normal((2, 2))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=slow(),
        vibrations=lines,
        noise_nm=2.0,
        sensor_matrix=sensor,
        influence_matrix=influence,
    )
    full = plant.full()
    a = np.array([line.ar_model(800).coefficients for line in lines])
    A1, minus_A2 = np.diag(a[:, 0]), np.diag(a[:, 1])
    I, Z = np.eye(2), np.zeros((2, 2))
    lines, air, seen = [A1, minus_A2, Z, Z, Z], [Z, Z, 0.98 * I, Z, Z], [I, Z, I, Z, Z]
    assert np.array_equal(full.A, np.block([lines, [I, Z, Z, Z, Z], air, seen, [Z] * 5]))
    assert np.all(np.linalg.eigvals(minus_A2) < 0)
    assert np.array_equal(full.B_known, np.vstack([Z, Z, Z, Z, I]))
    assert np.array_equal(full.L, np.hstack([I, Z, I, Z, Z]))
    C = np.hstack([sensor @ m for m in (Z, Z, Z, I, -influence)])
    assert np.allclose(full.C, C, rtol=1e-15)
    assert not np.any(full.D_known)


@pytest.mark.parametrize(
    ("design", "delay"),
    [(lbt.kalman, 1), (lbt.kalman, 2.5), (lambda p: lbt.hinf(p, gamma_ratio=1.2), 3)],
)
def test_full_and_reduced_form_give_the_same_controller(design, delay):
    plant = lbt_axis_plant(delay_frames=delay)
    form, n = plant.full(), plant.n_states
    matrices = {name: getattr(form, name) for name in "ABCDL"}
    reduced, full = design(plant), design(lbt.EstimationProblem(**matrices, dt_s=plant.dt_s))
    scale = np.abs(reduced.gain_predictor).max()
    assert np.allclose(full.gain_predictor[:n], reduced.gain_predictor, atol=1e-7 * scale)
    assert np.allclose(full.gain_predictor[n:], 0, atol=1e-7 * scale)
    whole = form.controller(full.gain_predictor, plant.hardware.projector @ form.L)
    f = np.geomspace(0.1, 400, 50)
    one, other = (c.to_statespace().frequency_response(f) for c in (reduced.controller, whole))
    assert np.allclose(one, other, rtol=1e-6)


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


def test_the_spectrum_is_the_mean_of_the_moved_ones(plant):
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4)
    line = plant.vibrations[0]
    f = np.concatenate([np.linspace(0, 400, 300), np.linspace(18, 22, 300)])
    moved = [line.at_frequency(g).ar_model(RATE).psd(f) for g in (19.25, 19.75, 20.25, 20.75)]
    total = sum(part.ar_model(RATE).psd(f) for part in spread.vibrations)
    np.testing.assert_allclose(total, np.mean(moved, axis=0), rtol=1e-11)
    assert np.hypot.reduce([v.rms_nm for v in spread.vibrations]) == pytest.approx(line.rms_nm)
    for part in spread.vibrations:
        assert part.damping * part.frequency_hz == pytest.approx(0.2)
        assert part.direction == line.direction
    assert lbt.kalman(spread).certificate.passed


def test_one_line_at_the_centre_is_the_plant_itself(plant):
    np.testing.assert_allclose(
        lbt.models.spread_plant(plant, half_width_hz=1.0, lines=1).A, plant.A, rtol=1e-12
    )
    two = lbt_axis_plant(modes=2)
    assert len(lbt.models.spread_plant(two, half_width_hz=1.0, lines=3).vibrations) == 6


def test_priors_that_cannot_be(plant):
    parts = {"turbulence": plant.turbulence[0], "noise_nm": 15.5, "modes": 1}
    none, fast = lbt.tip_tilt_plant(frame_rate_hz=RATE, **parts), retuned_plant(plant, 379.0)
    for wrong, arguments, words in (
        (none, {"half_width_hz": 1.0}, "needs a plant with a vibration"),
        (plant, {"half_width_hz": 20.0}, "half_width_hz must be below 20; got 20. All"),
        (plant, {"half_width_hz": 1.0, "lines": 65}, "lines must be at most 64"),
        (fast, {"half_width_hz": 9.0}, "below the Nyquist frequency"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            lbt.models.spread_plant(wrong, **arguments)
