"""Diagnoses of a short record, for the tests of their rows, sentences, pages and command."""

from functools import cache

from support.recorded_loops import LINE, RATE, spliced_record

import lbt_synth as lbt

GAIN = 0.2


@cache
def line_record():
    """One axis of 8192 frames with a line, on which an integrator of 0.2 ran."""
    return spliced_record(frames=8192, lines=LINE, gain=GAIN)


@cache
def line_diagnosis():
    return lbt.identification.diagnose(line_record(), given={"mine": given_design()})


@cache
def given_design():
    """A filter of the true line, but for calm air, little noise and a sensor gain of 1."""
    (frequency, damping, rms), *_ = LINE
    line = lbt.Vibration(frequency_hz=frequency, damping=damping, rms_nm=rms, direction=(1,))
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=1.0, frame_rate_hz=RATE)
    models = {"turbulence": air, "vibrations": [line], "noise_nm": 2.0}
    return lbt.kalman(lbt.tip_tilt_plant(frame_rate_hz=RATE, modes=1, **models))


def short_record(change=1.0):
    """A record that is too short for a model, with its commands changed."""
    record = line_record()
    y, u = (series[:1000] for series in (record.measurements, record.commands))
    return lbt.identification.loop_record(
        y, change * u, frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
