"""cacao's filter in numpy, against its C written out."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.interop.cacao.applied_filter import AppliedFilter


def reference(matrix, latency, series):
    """Frame by frame as modalfilter.c and applyPF.c do, with their ring and their indices."""
    single = np.float32
    matrix = np.asarray(matrix, single)
    modes, columns = matrix.shape
    ring, write = np.zeros((10, modes), single), 0
    inbuff = np.zeros(columns, single)
    whole = int(latency)
    part = single(latency - whole)
    out = []
    for y in np.asarray(series, single):
        # the command of this frame is written after it is known, where index 0 frames ago is
        now = (write + 1) % 10
        one, two = (now - whole) % 10, (now - whole - 1) % 10
        for mode in range(modes):
            late = single(part * ring[two, mode])
            late = single(float(late) + (1.0 - float(part)) * float(ring[one, mode]))
            inbuff[mode] = single(y[mode] - late)
        applied = np.zeros(modes, single)
        for mode in range(modes):
            for i in range(columns):
                applied[mode] = single(applied[mode] + single(inbuff[i] * matrix[mode, i]))
        inbuff[modes:] = inbuff[:-modes].copy()
        ring[write] = applied
        write = now
        out.append(-applied)
    return np.array(out, dtype=float)


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.25, 8.0])
def test_every_bit_is_that_of_the_program(delay):
    rng = np.random.default_rng(1)
    matrix, series = rng.standard_normal((2, 10)) / 4, rng.standard_normal((40, 2))
    run = AppliedFilter(matrix, delay)
    for _ in range(2):
        found = np.array([run.step(y) for y in series])
        assert np.array_equal(found, reference(matrix, delay + 1, series))
        run.reset()


def test_its_history_is_the_pseudo_open_loop_measurement():
    """In a loop with the same delay, the history is the phase, whatever is applied."""
    hardware = lbt.LoopHardware(frame_rate_hz=500, delay_frames=2.25, modes=1)
    taps = hardware.mirror_taps
    run = AppliedFilter([[-0.25, -0.5]], 2.25)
    phase = np.sin(np.arange(30) / 3)
    commands = np.zeros(len(taps) + 1)
    history = []
    for value in phase:
        y = value - taps @ commands[:-1]
        commands = np.append(run.step([y]), commands[:-1])
        history.append(run._history[0, 0])
    assert np.allclose(history, phase, atol=1e-6)


def test_a_matrix_of_part_of_a_frame_is_refused():
    with pytest.raises(lbt.errors.DimensionError, match="a row per mode"):
        AppliedFilter(np.ones((2, 5)))
