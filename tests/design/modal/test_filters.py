"""A Kalman filter for every mode, against that of one."""

from dataclasses import replace

import numpy as np
import pytest
from support.modal import HUM, LINE, RATE, single_plant, some_air

import lbt_synth as lbt
import lbt_synth.design.modal.filters
from lbt_synth.design.modal import modal_residuals
from lbt_synth.design.modal.filters import joining_check, modal_filters


def lines_of(lines, mode):
    """Vibrations of a mode as a list."""
    some = lines.get(mode, [])
    return [some] if isinstance(some, lbt.Vibration) else some


@pytest.mark.parametrize(
    ("delay", "order", "bandwidth"),
    [
        *((delay, order, None) for delay in (1, 1.3, 2, 2.6, 3, 4.5) for order in (1, 2)),
        *((delay, 1, bandwidth) for delay in (1, 2, 2.6) for bandwidth in (60.0, 500.0)),
    ],
)
def test_each_filter_is_that_of_kalman(delay, order, bandwidth):
    n, shell = 6, None
    if bandwidth is not None:
        shell = lbt.models.PositionLoop.from_bandwidth(
            natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
        )
    air = some_air(n, order)
    noise, gain = np.linspace(5, 30, n), np.linspace(0.5, 1.1, n)
    lines, known = {1: [LINE], 4: [LINE, HUM], 5: HUM}, {"delay_frames": delay, "mirror": shell}
    filters = modal_filters(air, noise_nm=noise, vibrations=lines, sensor_gain=gain, **known)
    path = filters.hardware
    assert (path.mirror, path.frame_rate_hz, path.delay_frames) == (shell, RATE, delay)
    exact = modal_residuals(filters, air, noise_nm=noise, vibrations=lines, sensor_gain=gain)
    assert np.allclose(exact, filters.rms_nm, rtol=1e-9)
    for i in range(n):
        own = lines_of(lines, i)
        one = lbt.kalman(single_plant(air, i, own, noise[i], gain[i], **known))
        mine = filters.design(i)
        assert np.array_equal(mine.gain_predictor, one.gain_predictor)
        for name in "ABCD":
            assert np.array_equal(getattr(mine.controller, name), getattr(one.controller, name))
        assert filters.certificate.rms_per_output[i] == one.rms
        moving = [
            replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz / RATE)) for line in own
        ]
        truth = lbt.Truth(turbulence=air.model(i), vibrations=moving, noise_nm=noise[i])
        path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[gain[i]]], **known)
        loop = lbt.close_loop(path, one.controller)
        budget = lbt.residual_budget(loop, truth)
        assert filters.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-8)


def test_equal_modes_share_a_design():
    air = some_air(2)
    slow, fast = air.model(0), air.model(1)
    known = {"noise_nm": [5.0, 5.0, 5.0, 6.0, 5.0], "vibrations": {4: LINE}}
    filters = modal_filters([slow, fast, slow, slow, slow], **known)
    assert filters.which.tolist() == [0, 1, 0, 2, 3]
    assert len(filters.designs) == 4
    assert filters.rms_nm[0] == filters.rms_nm[2]


def test_a_failing_mode_is_named(monkeypatch):
    air = some_air(4)
    filters = modal_filters(air, noise_nm=10.0)
    off = filters.rms_nm * np.array([1.0, 1.0, 1.001, 1.0])
    check = joining_check(off, filters.rms_nm)
    assert not check.passed
    assert check.name.endswith("(mode 2)")
    assert "modes 0, 1, 2 and 3" in joining_check(2 * off, filters.rms_nm).name
    assert not joining_check(np.full(4, np.nan), filters.rms_nm).passed

    def failing(plant):
        if plant.turbulence[0].driving_rms_nm == air.driving_rms_nm[2]:
            raise lbt.errors.CertificateError("no good", failed=("distance",))
        return lbt.kalman(plant)

    monkeypatch.setattr(lbt_synth.design.modal.filters, "kalman", failing)
    with pytest.raises(lbt.errors.CertificateError, match="filter of mode 2: no good") as caught:
        modal_filters(air, noise_nm=10.0)
    assert caught.value.failed == ("distance",)


def test_bad_filters_are_refused():
    air = some_air(3)
    for arguments, error, words in (
        ({"noise_nm": 0.0}, lbt.errors.ProblemError, "noise_nm must be above 0"),
        ({"noise_nm": [1.0, 2.0]}, lbt.errors.DimensionError, "one per mode .3."),
        ({"noise_nm": np.nan}, lbt.errors.NonFiniteError, "noise_nm"),
        ({"noise_nm": 1, "delay_frames": 0.5}, lbt.errors.ProblemError, "delay_frames"),
        (
            {"noise_nm": 1, "sensor_gain": -1},
            lbt.errors.ProblemError,
            "sensor_gain must be above 0",
        ),
        ({"noise_nm": 1, "vibrations": [LINE]}, lbt.errors.ProblemError, "must be a mapping"),
        (
            {"noise_nm": 1, "vibrations": {3: LINE}},
            lbt.errors.ProblemError,
            "must be at most 2; got 3",
        ),
        ({"noise_nm": 1, "vibrations": {0: 3}}, lbt.errors.ProblemError, "list of Vibration"),
        ({"noise_nm": 1, "mirror": 3}, lbt.errors.ProblemError, "PositionLoop"),
        ({"noise_nm": 1, "vibrations": {0: [1]}}, lbt.errors.ProblemError, "list of Vibration"),
    ):
        with pytest.raises(error, match=words):
            modal_filters(air, **arguments)
    filters = modal_filters([air.model(0)], noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="mode must be at most 0; got 1"):
        filters.design(1)
    with pytest.raises(lbt.errors.DimensionError, match=r"\(1,\)"):
        filters.start().step([1.0, 2.0])
    with pytest.raises(lbt.errors.ProblemError, match="y must be an array of numbers"):
        filters.start().step(["a"])


def test_filters_run_in_simulate():
    air = some_air(3)
    filters = modal_filters(air, noise_nm=8.0)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=3)
    truth = lbt.Truth(turbulence=air.model(0), noise_nm=8.0)
    run = lbt.simulate(filters.start(), truth, hardware=path, frames=300)
    # the same residual but for the frames before, whose total phase is not kept
    assert run.residual_nm.shape == (1, 300, 3)
    exact = modal_residuals(filters, [air.model(0)] * 3, noise_nm=8.0)
    assert run.rms_nm[0] == pytest.approx(np.linalg.norm(exact), rel=0.25)
