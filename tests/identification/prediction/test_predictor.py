"""The least-squares predictor, against textbook regression and closed forms.

The controller of a given order that leaves least of a measured spectrum.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.predictions import (
    CASES,
    FLAT,
    GOOD,
    PATH,
    RATE,
    STUCK,
    TILTED,
    a_plant,
    a_series,
)

import lbt_synth as lbt
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual


def textbook_regression(z, mirror_taps, taps, axes):
    m, rows, wanted = len(mirror_taps), [], []
    for k in range(m - 1 + taps, len(z)):
        row = []
        for axis in axes:
            row += [
                sum(c * z[k - late - i, axis] for i, c in enumerate(mirror_taps))
                for late in range(1, taps + 1)
            ]
        rows.append(row)
        wanted.append(z[k])
    return np.array(rows), np.array(wanted)


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.3])
def test_the_predictor_is_the_least_squares_of_a_textbook(delay):
    rng = np.random.default_rng(1)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
    z = np.cumsum(rng.standard_normal((300, 2)), axis=0) @ TILTED
    stretches = [(0, 130), (140, 300)]
    _, coefficients = lbt.identification.least_squares_predictor(
        z, path, taps=5, stretches=stretches
    )
    for i in range(2):
        parts = [textbook_regression(z[a:b], path.mirror_taps, 5, (i,)) for a, b in stretches]
        X, wanted = (np.concatenate([part[j] for part in parts]) for j in (0, 1))
        found, *_ = np.linalg.lstsq(X, wanted[:, i], rcond=None)
        np.testing.assert_allclose(coefficients[i], found, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), CASES)
def test_the_controller_of_the_predictor_gives_its_residual(delay, gain, mirror, sensor):
    """The loop around it leaves z less the FIR prediction: in a replay, to rounding."""
    rng = np.random.default_rng(4)
    base = a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    path = replace(base, sensor_matrix=gain * base.sensor)
    z = np.cumsum(rng.standard_normal((900, 2)), axis=0)
    controller, coefficients = lbt.identification.least_squares_predictor(z, path, taps=7)
    found = lbt.identification.replayed_residual(z, controller, path, noise_nm=1.0, from_rest=True)
    commands = np.zeros_like(z)
    for late in range(7):
        commands[late:] += z[: len(z) - late] * coefficients[:, late]
    wanted = z.copy()
    for i, tap in enumerate(path.mirror_taps):
        wanted[1 + i :] -= tap * commands[: len(z) - 1 - i]
    np.testing.assert_allclose(found.measured_nm, wanted, rtol=0, atol=1e-8)
    assert lbt.design.certify_loop(path, controller).passed


def test_ar_processes_are_predicted_as_in_closed_form():
    """Two frames ahead: a1 x(k+1) + a2 x(k) with x(k+1) = a1 x(k) + a2 x(k-1)."""
    a1, a2 = 1.6, -0.8
    model = lbt.models.ARModel(coefficients=[a1, a2], driving_rms_nm=1.0, frame_rate_hz=RATE)
    z = a_series(model, 60_000, np.random.default_rng(0))[:, None]
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    _, coefficients = lbt.identification.least_squares_predictor(z, path, taps=4)
    np.testing.assert_allclose(coefficients.ravel(), [a1**2 + a2, a1 * a2, 0, 0], rtol=0, atol=0.02)
    # one frame ahead the coefficients are those of Yule and Walker: the process's own
    near = lbt.LoopHardware(frame_rate_hz=RATE, modes=1, delay_frames=1)
    _, coefficients = lbt.identification.least_squares_predictor(z, near, taps=2)
    np.testing.assert_allclose(coefficients.ravel(), [a1, a2], rtol=0, atol=0.02)


@pytest.mark.parametrize("delay", [2.0, 2.4])
def test_more_taps_come_to_the_limit_and_none_passes_it(delay):
    """By the model, exactly: a predictor that was fitted to a long series, over its length."""
    line = lbt.Vibration(frequency_hz=40, damping=0.05, rms_nm=100, direction=(1,))
    fast = lbt.models.ARModel(coefficients=[0.95], driving_rms_nm=20.0, frame_rate_hz=RATE)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=fast,
        vibrations=[line],
        noise_nm=20.0,
        modes=1,
        delay_frames=delay,
    )
    path, rng = plant.hardware, np.random.default_rng(5)
    z = a_series(fast, 50_000, rng) + a_series(line.ar_model(RATE), 50_000, rng)
    z = (z + 20 * rng.standard_normal(z.size))[:, None]
    limit = least_model_residual(plant, frame_means=True).rms_nm
    left = []
    for taps in (1, 4, 16, 64):
        controller, _ = lbt.identification.least_squares_predictor(z, path, taps=taps)
        loop = lbt.close_loop(path, controller)
        left.append(lbt.residual_budget(loop, plant, frame_means=True).rms_nm / limit)
    assert np.all(np.diff(left) < 0)
    assert left[0] > 1.2
    assert 1 < left[-1] < 1.01


def test_regressors_that_depend_on_each_other():
    """A sinusoid without noise: two values say all; the coefficients of least norm are taken."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    z = 100 * np.sin(2 * np.pi * 20 / RATE * np.arange(3000))[:, None]
    controller, coefficients = lbt.identification.least_squares_predictor(z, path, taps=32)
    X, wanted = textbook_regression(z, path.mirror_taps, 32, (0,))
    found = np.linalg.pinv(X, rcond=1e-9) @ wanted[:, 0]
    np.testing.assert_allclose(coefficients.ravel(), found, rtol=0, atol=1e-9)
    assert np.sum(coefficients**2) < 1
    left = lbt.identification.replayed_residual(z, controller, path, noise_nm=0.0)
    assert np.max(np.abs(left.measured_nm)) < 1e-9


@pytest.mark.parametrize(
    ("path", "more", "message"),
    [
        (PATH, {"taps": 0}, "taps must be at least 1"),
        (PATH, {"taps": 1001}, "taps must be at most 1000"),
        (PATH, {"taps": 2.0}, "taps must be an integer"),
        (PATH, {"taps": 500}, "500 coefficients needs at least 2000 frames"),
        (PATH, {"stretches": [(0, 20), (30, 50)]}, "at least 128 frames to fit.* got 0"),
        (FLAT, {}, "sensor matrix that can be inverted"),
        (STUCK, {}, "influence matrix that can be inverted; got \\(2, 2\\) of rank 1"),
        (a_plant(), {}, "expected a LoopHardware"),
    ],
)
def test_predictors_that_are_refused(path, more, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        lbt.identification.least_squares_predictor(GOOD, path, **more)
