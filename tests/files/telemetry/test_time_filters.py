"""Controllers as a matrix and scalar filters, against the controllers step by step."""

import numpy as np
import pytest
from scipy.signal import lfilter
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.files.telemetry.time_filters import integrator_gains, time_filters


def filtered(filters, series):
    """Run the difference equations of time filters, channel after channel."""
    matrix, numerators, denominators = filters
    columns = []
    for projected, b, a in zip((series @ matrix.T).T, numerators, denominators, strict=True):
        top = np.flatnonzero(a)[-1]  # coefficients are those of rising powers of z
        columns.append(lfilter(b[top::-1], a[top::-1], projected))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("kind", ["integrator", "hinf", "projected", "delayed"])
def test_time_filters_give_the_commands_of_the_controller(kind):
    plant = lbt_axis_plant(modes=2, delay_frames=3.0 if kind == "delayed" else 2.0)
    skew = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=[[1.0, 0.3], [0.2, 0.9], [0.4, -1.0]])
    controller = {
        "integrator": lambda: lbt.integrator(plant.hardware, gain=0.3),
        "projected": lambda: lbt.integrator(skew, gain=0.3),
        "hinf": lambda: lbt.hinf(plant, gamma_ratio=1.2, route="riccati"),
    }.get(kind, lambda: lbt.kalman(plant))().controller
    filters = time_filters(controller)
    y = np.random.default_rng(0).standard_normal((120, controller.B.shape[1]))
    run = controller.start()
    u = np.array([run.step(row) for row in y])
    assert np.allclose(filtered(filters, y), u, atol=1e-7 * np.abs(u).max())
    gains = integrator_gains(*filters[1:])
    assert (gains is not None) == (kind in ("integrator", "projected"))
    if kind == "integrator":
        assert gains == pytest.approx([0.3, 0.3], rel=1e-12)


def test_controllers_without_time_filters_states_or_answer():
    coupled = lbt.Controller(
        A=np.diag([0.5, 0.9]), B=np.eye(2), C=[[1.0, 1.0], [0.0, 1.0]], D=np.zeros((2, 2))
    )
    assert time_filters(coupled) is None
    nothing = lbt.Controller(A=0.5, B=[[0.0, 0.0]], C=[[1.0], [0.0]], D=[[0.0, 0.0], [0.0, 3.0]])
    matrix, numerators, denominators = time_filters(nothing)
    assert numerators[0].any() == np.False_
    assert numerators[1, 0] / denominators[1, 0] == pytest.approx(3)
    assert matrix[1].tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("b", "a", "gains"),
    [
        ([0.0, 0.4], [-1.0, 1.0], [0.4]),
        ([0.0, 0.4], [-0.99, 1.0], None),
        ([0.4, 0.0], [-1.0, 1.0], None),
        ([0.0, 0.4], [1.0, 0.0], None),
    ],
)
def test_what_is_no_integrator(b, a, gains):
    found = integrator_gains(np.array([b]), np.array([a]))
    assert (found if found is None else found.tolist()) == gains
