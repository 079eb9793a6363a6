"""The plant with its past commands as states is the paper's."""

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt


def slow(pole=0.98, drive=50.0):
    return lbt.models.ARModel(coefficients=[pole], driving_rms_nm=drive, frame_rate_hz=800)


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
    expected = np.block(
        [
            [A1, minus_A2, Z, Z, Z],
            [I, Z, Z, Z, Z],
            [Z, Z, 0.98 * I, Z, Z],
            [I, Z, I, Z, Z],
            [Z, Z, Z, Z, Z],
        ]
    )
    assert np.array_equal(full.A, expected)
    assert np.all(np.linalg.eigvals(minus_A2) < 0)
    assert np.array_equal(full.B_known, np.vstack([Z, Z, Z, Z, I]))
    assert np.array_equal(full.L, np.hstack([I, Z, I, Z, Z]))
    assert np.allclose(
        full.C, np.hstack([sensor @ m for m in (Z, Z, Z, I, -influence)]), rtol=1e-15
    )
    assert not np.any(full.D_known)


def test_generalised_plant_of_the_hinf_filter():
    full = lbt_axis_plant().full()
    plant, known = full.generalised()
    n, w = full.B.shape
    assert np.array_equal(plant[:n, :n], full.A)
    assert np.array_equal(plant[n, :n], -full.L[0])
    assert plant[n, n + w] == 1
    assert np.array_equal(plant[n + 1, : n + w], np.hstack([full.C, full.D])[0])
    assert np.array_equal(known[:n], full.B_known)


@pytest.mark.parametrize("delay", [1, 1.3, 2, 2.5, 3, 4])
@pytest.mark.parametrize("design", [lbt.kalman, lambda p: lbt.hinf(p, gamma_ratio=1.2)])
def test_full_and_reduced_form_give_the_same_controller(delay, design):
    plant = lbt_axis_plant(delay_frames=delay)
    reduced, full = design(plant), design(plant.full())
    n = plant.A.shape[0]
    scale = np.abs(reduced.gain_predictor).max()
    assert np.allclose(full.gain_predictor[:n], reduced.gain_predictor, atol=1e-7 * scale)
    assert np.allclose(full.gain_predictor[n:], 0, atol=1e-7 * scale)
    f = np.geomspace(0.1, 400, 50)
    one, other = (d.controller.to_statespace().frequency_response(f) for d in (reduced, full))
    assert np.allclose(one, other, rtol=1e-6)
