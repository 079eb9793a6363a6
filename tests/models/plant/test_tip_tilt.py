"""The paper's state, entry by entry, and the equivalence of the two forms."""

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.models import ARModel
from lbt_synth.models.plant.tip_tilt import retuned_plant


def slow(pole=0.98, drive=50.0):
    return ARModel(coefficients=[pole], driving_rms_nm=drive, frame_rate_hz=800)


@pytest.mark.parametrize("delay", [1, 2, 3, 4])
@pytest.mark.parametrize("order", [1, 2])
def test_predicted_error_is_the_closed_loops_residual(delay, order):
    """Where truth is the model, the filter's rms is the residual of the loop, exactly."""
    coefficients = [0.99] if order == 1 else [1.95, -0.955]
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
        influence_matrix=rng.standard_normal((2, 2)),
    )
    design = lbt.kalman(plant)
    truth = lbt.Truth(turbulence=turbulence, vibrations=(line,), noise_nm=9.0)
    loop = lbt.close_loop(plant.hardware, design.controller)
    budget = lbt.residual_budget(loop, truth, frame_means=True)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_more_commands_than_modes_use_the_generalised_inverse():
    rng = np.random.default_rng(5)
    influence = rng.standard_normal((2, 5))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=slow(), noise_nm=2.0, influence_matrix=influence
    )
    design = lbt.kalman(plant)
    simple = lbt.kalman(lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow(), noise_nm=2.0))
    truth = lbt.Truth(turbulence=slow(), noise_nm=2.0)
    one, other = (
        lbt.residual_budget(lbt.close_loop(d.hardware, d.controller), truth).rms_nm
        for d in (design, simple)
    )
    assert one == pytest.approx(other, rel=1e-9)
    assert design.controller.C.shape[0] == 5


def test_sensor_gain_of_the_design_is_undone():
    """A loop that is designed for sensor gain 0.5 behaves like the unit one at half the noise."""
    parts = {"frame_rate_hz": 800, "turbulence": slow()}
    halved = lbt.kalman(lbt.tip_tilt_plant(**parts, noise_nm=2.0, sensor_gain=0.5))
    unit = lbt.kalman(lbt.tip_tilt_plant(**parts, noise_nm=4.0))
    assert halved.rms == pytest.approx(unit.rms, rel=1e-12)
    assert np.allclose(0.5 * halved.gain_predictor, unit.gain_predictor, rtol=1e-10)


def test_noise_covariance_may_be_given():
    covariance = np.array([[9.0, 2.0], [2.0, 4.0]])
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow(), noise_nm=covariance)
    assert np.allclose(plant.R, covariance)


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
        ({"vibrations": []}, "vibrations is empty"),
        ({"noise_nm": 0.0}, "noise_nm must be above 0"),
        ({"noise_nm": [[1.0, 2.0], [0.0, 1.0]]}, "noise_nm must be symmetric"),
        ({"noise_nm": [[1.0, 2.0], [2.0, 1.0]]}, "noise_nm must be positive definite"),
        ({"noise_nm": np.eye(3)}, "to match the measurements"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1; got 0.5"),
        ({"delay_frames": 20.5}, "delay_frames must be at most 20; got 20.5"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        ({"sensor_matrix": np.eye(3), "influence_matrix": np.eye(2)}, "to match sensor_matrix"),
        ({"sensor_matrix": [[np.nan, 0], [0, 1]]}, "sensor_matrix must be finite"),
        ({"turbulence": [slow()] * 3}, r"one per mode \(2\); got 3"),
        (
            {"turbulence": ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)},
            "must be sampled at the frame rate",
        ),
        (
            {"vibrations": [lbt.Vibration(frequency_hz=9, damping=0.1, rms_nm=1, direction=(1,))]},
            "must have 2 components",
        ),
        (
            {"vibrations": [lbt.Vibration(frequency_hz=450, damping=0.1, rms_nm=1)]},
            "below the Nyquist",
        ),
    ],
)
def test_wrong_parts_are_refused(change, text):
    parts = {"frame_rate_hz": 800, "turbulence": slow(), "noise_nm": 2.0} | change
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.tip_tilt_plant(**parts)


def test_sizes_that_clash_are_named():
    sizes = {"A": (3, 3), "B": (3, 4), "C": (1, 3), "D": (1, 4), "L": (1, 3)}
    wrong = {"A": (3, 2), "B": (2, 4), "C": (1, 2), "D": (1, 3), "L": (1, 5)}
    good = {name: np.ones(size) for name, size in sizes.items()} | {"A": np.eye(3) / 2}
    for name, size in wrong.items():
        with pytest.raises(lbt.errors.DimensionError, match=f"{name} must"):
            lbt.EstimationProblem(**(good | {name: np.ones(size)}))
    with pytest.raises(lbt.errors.DefinitenessError, match="Every measurement needs noise"):
        lbt.EstimationProblem(A=0.5, B=[[1.0]], C=1.0, D=[[0.0]], L=1.0)
