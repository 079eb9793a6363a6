"""A stack of one-mode designs: each is that of kalman, and the loops of all leave what one does."""

from dataclasses import replace

import numpy as np
import pytest
from support.modal import (
    HUM,
    LINE,
    RATE,
    joint_controller,
    path_of,
    single_plant,
    some_air,
    tip_tilt_filter,
)
from support.recorded_runs import recorded_run
from support.refusals import require_refusals

import lbt_synth as lbt
import lbt_synth.design.modal.stack
from lbt_synth.design.modal import MixedController, modal_filters
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.loop.budget import ensemble_residuals
from lbt_synth.loop.ensemble import LoopEnsemble
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.models import ARModel, PositionLoop


@pytest.mark.parametrize(
    ("delay", "order", "bandwidth"),
    [(1, 1, None), (1.3, 2, None), (2, 2, None), (4.5, 1, None), (1, 1, 500.0), (2.6, 1, 60.0)],
)
def test_each_filter_is_that_of_kalman(delay, order, bandwidth):
    n, shell = 3, None
    if bandwidth is not None:
        shell = PositionLoop.from_bandwidth(
            natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
        )
    air = some_air(n, order)
    noise, gain = np.linspace(5, 30, n), np.linspace(0.5, 1.1, n)
    known = {"delay_frames": delay, "mirror": shell}
    conditions = {"noise_nm": noise, "vibrations": {1: [LINE, HUM], 2: HUM}, "sensor_gain": gain}
    conditions["hardware"] = path_of(**known)
    filters = modal_filters(air, **conditions)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (shell, RATE, delay)
    for i, mode_lines in enumerate(([], [LINE, HUM], [HUM])):
        one = lbt.kalman(single_plant(air, i, mode_lines, noise[i], gain[i], **known))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        moving = [
            replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE))
            for line in mode_lines
        ]
        truth = lbt.Truth(turbulence=air.take(i), vibrations=moving, noise_nm=noise[i])
        path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[gain[i]]], **known)
        budget = lbt.residual_budget(lbt.close_loop(path, one.controller), truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


def test_equal_modes_share_a_design():
    air = some_air(2)
    slow, fast = air.take(0), air.take(1)
    known = {"noise_nm": [5.0, 5.0, 5.0, 6.0, 5.0], "vibrations": {4: LINE}}
    filters = modal_filters([slow, fast, slow, slow, slow], hardware=path_of(), **known)
    assert filters.which.tolist() == [0, 1, 0, 2, 3]
    assert len(filters.designs) == 4
    assert filters.rms_nm[0] == filters.rms_nm[2]


def test_a_failing_mode_is_named(monkeypatch):
    air = some_air(4)

    def failing(plant):
        if plant.turbulence[0].driving_rms_nm == air.driving_rms_nm[2]:
            raise lbt.errors.CertificateError("no good", failed=("distance",))
        return lbt.kalman(plant)

    monkeypatch.setattr(lbt_synth.design.modal.stack, "kalman", failing)
    with pytest.raises(lbt.errors.CertificateError, match="filter of mode 2: no good") as caught:
        modal_filters(air, hardware=path_of(), noise_nm=10.0)
    assert caught.value.failed == ("distance",)


def test_bad_filters_are_refused():
    air = some_air(3)

    def filters(noise_nm=1, **options):
        options = {"hardware": path_of(), "noise_nm": noise_nm} | options
        return lambda: modal_filters(air, **options)

    made = modal_filters([air.take(0)], hardware=path_of(), noise_nm=1.0)
    lines = "list of Vibration"
    require_refusals(
        [
            (filters(0.0), ProblemError, "noise_nm must be above 0"),
            (filters([1.0, 2.0]), DimensionError, "one per mode .3."),
            (filters(np.nan), NonFiniteError, "noise_nm"),
            (filters(hardware=3), ProblemError, "hardware must be a LoopHardware"),
            (filters(hardware=path_of(frame_rate_hz=400)), ProblemError, "loop's 400 Hz; got 800"),
            (filters(sensor_gain=-1), ProblemError, "sensor_gain must be above 0"),
            (filters(vibrations=[LINE]), ProblemError, "must be a mapping"),
            (filters(vibrations={3: LINE}), ProblemError, "must be at most 2; got 3"),
            (filters(vibrations={0: 3}), ProblemError, lines),
            (filters(vibrations={0: [1]}), ProblemError, lines),
            (lambda: made.design(1), ProblemError, "mode must be at most 0; got 1"),
        ]
    )


def law(gain, leak=1.0):
    return lbt.Controller(A=leak, B=gain, C=1.0, D=0.0, dt_s=1 / RATE)


def controller_of(kind, n, delay):
    """Return a controller of n modes, and the controllers of some modes that it is made of."""
    air, gains, leak = some_air(n), np.linspace(0.1, 0.3, n), np.linspace(0.98, 1, n)
    path = path_of(delay_frames=delay)
    filters, filtered, parts = None, (), []
    if kind == "filters":
        filters = modal_filters(air, hardware=path, noise_nm=8.0, vibrations={0: [LINE]})
        filtered = range(n)
    elif kind == "mixed":
        filters, filtered = tip_tilt_filter(delay), (3, 1)
        parts = [(filtered, filters.controller)]
    elif kind == "both":
        filters = modal_filters([air.take(0)] * 2, hardware=path, noise_nm=8.0)
        filtered = (2, 0)
    if kind in ("filters", "both"):
        parts = [((mode,), filters.design(i).controller) for i, mode in enumerate(filtered)]
    parts += [((i,), law(gains[i], leak[i])) for i in range(n) if i not in filtered]
    known = {"filtered": filtered} if filters else {}
    return MixedController(filter=filters, gains=gains, leak=leak, **known), parts


@pytest.mark.parametrize(
    ("kind", "delay"), [("integrators", 2.7), ("filters", 1.4), ("mixed", 1), ("both", 3)]
)
def test_stepped_modes_are_the_linear_controller_of_all(kind, delay):
    n, frames = 5, 900  # some filters alone grow by 1.04 a frame
    controller, parts = controller_of(kind, n, delay)
    rng = np.random.default_rng(4)
    total, noise = 100 * rng.standard_normal((frames, n)), 8 * rng.standard_normal((frames, n))
    gain = np.linspace(0.6, 1.1, n)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, sensor_matrix=np.diag(gain))
    stepped = recorded_run(controller, path, total, noise)
    linear = recorded_run(joint_controller(parts, n), path, total, noise)
    assert np.allclose(stepped, linear, atol=1e-10 * np.abs(linear).max())


def test_a_process_that_is_all_but_a_walk_leaves_what_a_walk_leaves():
    """The residual under a random walk is AR2, ``e(k+1) = e(k) - g e(k-1) + v + g n``."""
    g, v, n = 0.5, 10.0, 5.0
    walk = np.sqrt((1 + g) / ((1 - g) * ((1 + g) ** 2 - 1)) * (v**2 + g**2 * n**2))
    for distance in (1e-7, 1e-12, 1e-15):
        air = ARModel(
            coefficients=[[0.9], [1 - distance]], driving_rms_nm=[1.0, v], frame_rate_hz=RATE
        )
        ensemble = LoopEnsemble(loops=2, turbulence=[air], noise_nm=[[n], [n]])
        left = ensemble_residuals(
            textbook_matrices([law(g)]), path_of(modes=1), ensemble, frame_means=True
        )
        assert left.rms_nm[1] == pytest.approx(walk, rel=1e-7)
