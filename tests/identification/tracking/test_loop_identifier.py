"""The whole model identified in a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.tracking import AIR, axis, line, sensed, simulated

import lbt_synth as lbt


def test_the_whole_model_is_found_in_a_window():
    """Two axes with other lines, noises and gains than the plant believes."""
    believed = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=AIR,
        noise_nm=10,
        vibrations=[replace(line(20), direction=(1, 0))],
    )
    gains, noises, lines_hz = (0.7, 1.0), (12.0, 25.0), (23.0, 41.0)
    true = [
        replace(line(hz, damping=0.01), direction=tuple(np.eye(2)[i]))
        for i, hz in enumerate(lines_hz)
    ]
    path = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=np.diag(gains))
    truth = lbt.Truth(turbulence=AIR, vibrations=true, noise_nm=list(noises))
    loop = lbt.simulate(
        lbt.integrator(path, gain=0.5).controller, truth, hardware=path, frames=8000, seed=3
    )
    y, u = loop.measurements[0, 2:], loop.commands[0, :-2]
    identify = lbt.identification.LoopIdentifier(believed)
    for _ in range(2):  # from nothing, and from what it was
        found = identify(y, u)
        assert np.allclose(np.diag(found.hardware.sensor), gains, rtol=0.12)
        assert np.allclose(np.sqrt(np.diag(found.R)), noises, rtol=0.05)
        for v in true:
            along = [w for w in found.vibrations if w.direction == v.direction]
            assert min(abs(w.frequency_hz - v.frequency_hz) for w in along) < 0.5
    assert lbt.kalman(found).certificate.passed
    given = lbt.identification.LoopIdentifier(believed, find_gain=False, most_lines=1)(y, u)
    assert np.array_equal(given.hardware.sensor, believed.hardware.sensor)


def test_wrong_identifiers_are_refused():
    plant = axis(20)
    with pytest.raises(lbt.errors.ProblemError, match="each measurement must be of one axis"):
        lbt.identification.LoopIdentifier(sensed(None))
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.identification.LoopIdentifier(None)
    with pytest.raises(lbt.errors.ProblemError, match="most_lines must be at least 0"):
        lbt.identification.LoopIdentifier(plant, most_lines=-1)
    identify = lbt.identification.LoopIdentifier(plant)
    with pytest.raises(lbt.errors.DimensionError, match=r"must be \(frames, 1\)"):
        identify(np.zeros((3200, 1)), np.zeros((3200, 2)))
    # a window that is too short is noted in the history of the tracker
    tracker = lbt.identification.TrackingController(plant, window_s=0.25)
    simulated(tracker, frames=400)
    assert tracker.kept == len(tracker.history) > 0
    assert "at least 512 frames" in tracker.history[0].reason
