"""The controller of a given order that leaves least of a measured spectrum."""

import numpy as np
import pytest
from support.predictions import SHELL
from support.short_split import GAIN, PATH, TRUTH, short_split

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.linear.block_filtering import filter_series

spectral_design = lbt.identification.spectral_design


@pytest.fixture(scope="module")
def split():
    return short_split()


def test_it_comes_near_the_least_residual(split):
    found = spectral_design(split.open_loop, split.hardware, order=5, stretches=split.training)
    left = lbt.residual_budget(lbt.close_loop(PATH, found, sensor_gain=GAIN), TRUTH)
    least = lbt.loop.least_residual(PATH, TRUTH).rms_nm
    assert 0.999 < left.rms_nm / least < 1.05


def test_more_poles_leave_less_of_what_they_are_fitted_to(split):
    left = []
    for order in (2, 4):
        controller = spectral_design(
            split.open_loop, split.hardware, order=order, stretches=split.training
        )
        path = lbt.close_loop(split.hardware, controller).rejection()
        ((start, stop),) = split.training
        left.append(np.mean(filter_series(path, split.open_loop[:stop])[start + 100 :] ** 2))
    assert left[0] > 1.2 * left[1]  # two poles are for the line, two for the rest


@pytest.mark.parametrize(("delay", "mirror"), [(1.0, None), (2.5, None), (2.0, SHELL)])
def test_the_loop_is_stable_for_any_delay_and_mirror(delay, mirror):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, modes=1, mirror=mirror)
    rng = np.random.default_rng(2)
    walk, noise = rng.standard_normal((2, 4000, 1))
    series = np.cumsum(5 * walk, axis=0) + 20 * noise
    found = spectral_design(series, path, order=3, sensor_gain=0.5)
    loop = lbt.close_loop(path, found, sensor_gain=0.5)
    assert loop.is_stable
    left = filter_series(loop.rejection(), series)
    assert np.var(left) < 3 * 20**2 < 0.1 * np.var(series)


def test_axes_do_not_mix():
    rng = np.random.default_rng(4)
    series = np.cumsum(rng.standard_normal((3000, 2)), axis=0) @ np.diag([1.0, 10.0])
    path = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=np.diag([0.5, 0.7]))
    both = spectral_design(series, path, order=2)
    one = spectral_design(
        series[:, 1:], lbt.LoopHardware(frame_rate_hz=800, modes=1), order=2, sensor_gain=0.7
    )
    f = np.array([0.0, 10.0, 200.0])
    response = both.to_statespace().frequency_response(f)
    assert response[:, 1, 1] == pytest.approx(one.to_statespace().frequency_response(f)[:, 0, 0])
    assert np.max(np.abs(response[:, [0, 1], [1, 0]])) < 1e-9


@pytest.mark.parametrize(
    ("options", "words"),
    [({"order": 1}, "order must be at least 2"), ({"sensor_gain": 0.0}, "sensor_gain")],
)
def test_values_out_of_range(split, options, words):
    with pytest.raises(ProblemError, match=words):
        spectral_design(split.open_loop, split.hardware, stretches=split.training, **options)
