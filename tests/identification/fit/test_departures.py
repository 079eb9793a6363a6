"""Sinusoids that drift, and jumps in a record: found, noted, and cut out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from support.recorded_loops import LINE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.fit.departures import cut_around, measure_drift

RATE = 200.0
SECONDS = 30.0
BAND_HZ = (17.0, 24.0)


def wave(drift_hz: float, *, half_width: float = 0.0, seed: int = 0) -> np.ndarray:
    """A line of 50 nm rms from 20 Hz upwards, of a half width in bins, under noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(SECONDS * RATE)) / RATE
    size = np.full(t.size, np.exp(1j * rng.uniform(0, 6)))
    if half_width:
        decay = np.exp(-2 * np.pi * half_width / t.size)
        drive = rng.standard_normal(2 * t.size).view(complex) * np.sqrt((1 - decay**2) / 2)
        start = rng.standard_normal(2).view(complex) / np.sqrt(2)
        size = lfilter([1], [1, -decay], drive, zi=decay * start)[0]
    turns = 20.0 * t + drift_hz / SECONDS * t**2 / 2
    line = 50 * np.sqrt(2) * (size * np.exp(2j * np.pi * turns)).real
    return line + 5 * rng.standard_normal(t.size)


@pytest.mark.parametrize("drift_hz", [-0.5, 0.2, 1.0, 3.0])
def test_a_drift_is_measured(drift_hz: float) -> None:
    found = measure_drift(wave(drift_hz), RATE, BAND_HZ)
    assert found is not None
    assert found.is_clear
    assert found.rate_hz_s * SECONDS == pytest.approx(drift_hz, abs=0.02)
    assert found.frequency_hz == pytest.approx(20 + drift_hz / 2, abs=0.02)
    assert found.rms_nm == pytest.approx(50, rel=0.05)


def test_steady_sinusoids_and_narrow_resonances_do_not_drift() -> None:
    for half_width, most in ((0.0, 0), (0.3, 1), (1.0, 1), (3.0, 1)):
        found = [
            measure_drift(wave(0.0, half_width=half_width, seed=i), RATE, BAND_HZ)
            for i in range(15)
        ]
        assert sum(drift is not None and drift.is_clear for drift in found) <= most


def test_a_band_of_few_bins_has_no_drift() -> None:
    assert measure_drift(wave(1.0), RATE, (20.0, 20.3)) is None


@pytest.mark.parametrize("drift_hz", [0.0, 1.0])
def test_the_rms_of_a_line_that_drifts_is_honest(drift_hz: float) -> None:
    z = wave(drift_hz) + lfilter([1], [1, -0.99], np.random.default_rng(1).standard_normal(6000))
    record = lbt.identification.loop_record(z[:, None], frame_rate_hz=RATE, unit="nm")
    model = lbt.identify(record)
    found = [part for part in model.axes[0].lines if part.rms_nm > 2]
    together = np.sqrt(sum(line.rms_nm**2 for line in found))
    strongest = max(found, key=lambda line: line.rms_nm)
    relative = strongest.rms_error_nm / strongest.rms_nm
    assert together == pytest.approx(50, rel=2 * relative)
    assert relative < 0.15
    away = strongest.frequency_hz - 20 - drift_hz / 2
    assert abs(away) < max(2 * strongest.frequency_error_hz, 0.002)
    assert strongest.frequency_error_hz > drift_hz / 4
    notes = [note for note in model.notes if "drifts by" in note]
    assert len(notes) == (drift_hz > 0)
    assert all(f"{drift_hz:.2g} Hz in 30 s" in note for note in notes)


def test_a_line_of_both_axes_that_drifts_keeps_its_direction() -> None:
    noise = np.random.default_rng(2).standard_normal((2, int(SECONDS * RATE)))
    z = np.array([[0.8], [0.6]]) * wave(0.5) + 5 * noise
    record = lbt.identification.loop_record(z.T, frame_rate_hz=RATE, unit="nm")
    model = lbt.identify(record)
    drifting = [line for line in model.shared if line.frequency_error_hz > 0.1]
    assert drifting
    assert np.sqrt(sum(line.rms_nm**2 for line in drifting)) == pytest.approx(50, rel=0.1)
    assert [line.direction_deg for line in drifting] == pytest.approx(
        [36.87] * len(drifting), abs=3
    )
    assert sum("drifts by" in note for note in model.notes) == 2


def test_a_jump_is_found_noted_and_cut() -> None:
    clean = lbt.identify(spliced_record(lines=LINE, frames=20_000))
    spliced = spliced_record((0, 1), lines=LINE, frames=20_000)
    found = lbt.identify(spliced)
    assert not clean.notes
    assert all(note.startswith("warning: 1 jump of the") for note in found.notes)
    assert "the record was cut there" in found.notes[0]
    axis = found.axes[0]
    assert axis.sensor_gain_error is not None
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.noise_nm == pytest.approx(6, abs=4 * axis.noise_error_nm)


@pytest.mark.parametrize("lost", [(5008, 6154), (3000, 4500), (7000, 9900), (2000, 9000)])
def test_frames_that_were_lost_do_not_move_the_gain(lost: tuple[int, int]) -> None:
    whole = spliced_record((3,), lines=LINE, frames=20_000)
    y, u = (
        np.vstack([series[: lost[0]], series[lost[1] :]])
        for series in (whole.measurements, whole.commands)
    )
    spliced = lbt.identification.loop_record(y, u, frame_rate_hz=1000, delay_frames=2, unit="nm")
    found = lbt.identify(spliced)
    axis = found.axes[0]
    assert axis.sensor_gain_error is not None
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.sensor_gain_error < 0.05
    assert any("jump" in note for note in found.notes)


def test_stretches_are_cut() -> None:
    assert cut_around(((0, 100), (200, 300)), [50, 200]) == ((0, 47), (53, 100), (203, 300))
    assert cut_around(((0, 4),), [1]) == ()
