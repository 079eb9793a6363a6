"""Vibrations whose frequency has a prior."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from support.plants import lbt_axis_plant

import lbt_synth as lbt

RATE = 800


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


def test_the_spectrum_is_the_mean_of_the_moved_ones(plant):
    weights = [1.0, 2.0, 4.0, 1.0]
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4, weights=weights)
    line = plant.vibrations[0]
    f = np.concatenate([np.linspace(0, 400, 300), np.linspace(18, 22, 300)])
    moved = [line.at_frequency(g).ar_model(RATE).psd(f) for g in (19.25, 19.75, 20.25, 20.75)]
    total = sum(part.ar_model(RATE).psd(f) for part in spread.vibrations)
    np.testing.assert_allclose(total, np.average(moved, axis=0, weights=weights), rtol=1e-11)
    assert np.hypot.reduce([v.rms_nm for v in spread.vibrations]) == pytest.approx(line.rms_nm)
    for part in spread.vibrations:
        assert part.damping * part.frequency_hz == pytest.approx(0.2)
        assert part.direction == line.direction
    assert lbt.kalman(spread).certificate.passed


def test_the_prior_filter_is_the_best_on_average(plant):
    """Of the filters at hand it has the least mean variance over the frequencies of the prior."""
    frequencies = [19.2, 19.6, 20.0, 20.4, 20.8]
    spread = lbt.models.spread_plant(plant, frequencies_hz=frequencies)
    line = plant.vibrations[0]
    plants = [
        lbt.tip_tilt_plant(
            frame_rate_hz=RATE,
            turbulence=plant.turbulence,
            vibrations=[line.at_frequency(f)],
            noise_nm=15.5,
            modes=1,
        )
        for f in frequencies
    ]

    def mean(design):
        return np.mean([error_variance(truth, design) for truth in plants])

    best = lbt.kalman(spread)
    assert mean(best) == pytest.approx(best.rms**2, rel=1e-8)
    for other in (lbt.kalman(plant), lbt.hinf(plant, route="riccati"), lbt.kalman(plants[0])):
        assert mean(other) > 1.005 * best.rms**2


def error_variance(truth, design):
    """Variance of the prediction error of a filter in another plant, from both states at once."""
    model, gain = design.problem, design.gain_predictor
    zero = np.zeros((len(truth.A), len(model.A)))
    A = np.block([[truth.A, zero], [gain @ truth.C, model.A - gain @ model.C]])
    B = np.vstack([truth.B, gain @ truth.D])
    C = np.hstack([truth.L, -model.L])
    return float(np.trace(C @ solve_discrete_lyapunov(A, B @ B.T) @ C.T))


def test_one_line_at_the_centre_is_the_plant_itself(plant):
    np.testing.assert_allclose(
        lbt.models.spread_plant(plant, half_width_hz=1.0, lines=1).A, plant.A, rtol=1e-12
    )
    two = lbt_axis_plant(modes=2)
    assert len(lbt.models.spread_plant(two, half_width_hz=1.0, lines=3).vibrations) == 6


def test_priors_that_cannot_be(plant):
    common = {
        "frame_rate_hz": RATE,
        "turbulence": plant.turbulence[0],
        "noise_nm": 15.5,
        "modes": 1,
    }
    lines = [plant.vibrations[0], plant.vibrations[0].retuned(30, frame_rate_hz=RATE)]
    two, none = lbt.tip_tilt_plant(vibrations=lines, **common), lbt.tip_tilt_plant(**common)
    for wrong, arguments, text in (
        (none, {"half_width_hz": 1.0}, "needs a plant with a vibration"),
        (plant, {}, "give one of half_width_hz and frequencies_hz"),
        (plant, {"half_width_hz": 1.0, "frequencies_hz": [20.0]}, "give one of"),
        (plant, {"half_width_hz": 0.0}, "half_width_hz must be above 0"),
        (plant, {"half_width_hz": 20.0}, "half_width_hz must be below 20; got 20. All"),
        (plant, {"half_width_hz": 1.0, "lines": 0}, "lines must be at least 1"),
        (plant, {"half_width_hz": 1.0, "lines": 65}, "lines must be at most 64"),
        (plant, {"half_width_hz": 1.0, "weights": [1.0]}, "weights must be 5 positive numbers"),
        (plant, {"frequencies_hz": [19.0, 21.0], "weights": [1.0, 0.0]}, "weights must be 2"),
        (plant, {"frequencies_hz": [19.0, 401.0]}, "below the Nyquist frequency"),
        (plant, {"frequencies_hz": [-1.0]}, "got -1 Hz"),
        (plant, {"frequencies_hz": [np.inf]}, "frequencies_hz must be finite"),
        (
            two,
            {"frequencies_hz": [19.0]},
            "vibrations of one frequency; got vibrations at 20 and 30",
        ),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=text):
            lbt.models.spread_plant(wrong, **arguments)
