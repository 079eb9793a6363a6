"""A design from a record, and what is noted against it."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import LINE, RATE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.auto import note_drift

DRIFT_HZ = 500.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=DRIFT_HZ)


def test_a_design_is_doubted_where_the_gains_disagree() -> None:
    first = spliced_record((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    second = spliced_record((1,), lines=LINE, frames=12_000, sensor_gain=0.4)
    both = lbt.identification.loop_record(
        np.vstack([first.measurements[:12_000], second.measurements]),
        np.vstack([first.commands[:12_000], second.commands]),
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    try:
        notes = lbt.design_from_record(both).notes
    except lbt.errors.CertificateError as error:
        notes = (str(error),)
    assert any("sensor gain" in note for note in notes)
    given = lbt.design_from_record(first, method="hinf")
    assert (given.notes, given.choice, given.name) == ((), None, "H-infinity filter")


def test_a_design_needs_a_delay_and_data():
    noise = np.random.default_rng(0).standard_normal((9000, 1))
    with pytest.raises(
        lbt.errors.ProblemError, match="delay of this loop is not known; give delay_frames"
    ):
        lbt.design_from_record(
            lbt.identification.loop_record(noise, noise, frame_rate_hz=RATE, unit="nm")
        )
    with pytest.raises(lbt.errors.ProblemError, match="LoopRecord"):
        lbt.design_from_record(noise)
    short = lbt.identification.loop_record(
        noise[:900], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 8000 usable frames \(8 s at 1000 Hz\).*got 900 \(0.9"
    ):
        lbt.design_from_record(short)
    with pytest.raises(lbt.errors.ProblemError, match="method"):
        lbt.design_from_record(short, method="magic")


def drifting_record(offset_nm: float, speed_nm_s: float) -> lbt.identification.LoopRecord:
    """A record of noise whose commands move, on the second axis; its sensor gain is 0.5."""
    noise = np.random.default_rng(0).standard_normal((5000, 2))
    commands = np.zeros((5000, 2))
    commands[:, 1] = offset_nm + speed_nm_s * (np.arange(5000) - 2500) / DRIFT_HZ
    return lbt.identification.loop_record(
        noise, commands, frame_rate_hz=DRIFT_HZ, delay_frames=2, unit="nm"
    )


def test_what_a_filter_leaves_of_a_drift_is_noted():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=DRIFT_HZ, turbulence=SLOW, noise_nm=5.0, sensor_gain=0.5
    )
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    left = abs(loop.sensitivity([1e-6])[0, 1, 1])
    assert 0.01 < left < 0.5
    residual = np.array([10.0, 10.0])
    assert list(note_drift(drifting_record(10.0, 1.0), loop, residual)) == []
    (note,) = note_drift(drifting_record(3000.0, -200.0), loop, residual)
    assert note.startswith("axis 1 of the record stands 3e+03 nm off zero and drifts by -200 nm/s.")
    said = float(note.split("leaves up to ")[1].split(" nm")[0])
    assert said == pytest.approx(left * (3000 + 5 * 200), rel=0.05)
