"""Channels that leave more of a record than the wavefront alone does, found by a replay.

A model says what a channel buys where its noise is white and its clock steady. Hum, wandering
offsets, jumps of a clock and motions that do not follow a line are in the record, so the filters
run over it: that of all channels, and that of none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.fusion.failures import fallback_gains
from lbt_synth.identification.accelerometers.laying import at_loop_rate
from lbt_synth.identification.accelerometers.readings import fill_missing
from lbt_synth.identification.accelerometers.transfers import AccelerometerTransfers
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.loop.fusion.fused_loop import close_fused_loop
from lbt_synth.models.fusion.plant import FusedPlant, fused_plant
from lbt_synth.models.fusion.sensors import Accelerometer, Motion, SensorSuite
from lbt_synth.validation import FloatArray

_SETTLING_S = 1.0
_FACTORS = (3.0, 10.0, 30.0, 100.0)  # of the noise
_LEFT_OUT = (
    "left out, because the filter leaves more of this record with it: hum, drift, lost readings?"
)


def drop_harmful(
    found: AccelerometerTransfers,
    model: IdentifiedModel,
    record: LoopRecord,
    accelerations: ArrayLike,
) -> AccelerometerTransfers:
    """Return the transfers without channels by which a filter leaves more of the record.

    While the Kalman filter of wavefront and channels leaves more than that of the wavefront, the
    channel goes without which least is left. If less is left by all of them with more noise, they
    stay with that. Accelerations are those given for the transfers.
    """
    if not found.used:
        return found
    plant = _plant(found, model)
    series = _open_loop_readings(plant, found, model, record, accelerations)
    if not series:
        return found
    channels = plant.suite.channels
    alone = _power(plant, series, channels)
    out: tuple[str, ...] = ()
    power = whole = _power(plant, series, out)
    while len(out) < len(channels) and power > alone:
        fewer = [(*out, name) for name in channels if name not in out]
        out = min(fewer, key=lambda some: _power(plant, series, some))
        power = _power(plant, series, out)
    if whole > alone:
        tried = [found.noisier(factor) for factor in _FACTORS]
        powers = [_power(_plant(each, model), series, ()) for each in tried]
        if min(powers) < power:
            return tried[int(np.argmin(powers))]
    return found.without(out, _LEFT_OUT) if out else found


def _plant(found: AccelerometerTransfers, model: IdentifiedModel) -> FusedPlant:
    used = found.used
    instrument = Accelerometer(
        name="accelerometer",
        rate_hz=found.rate_hz,
        delay_frames=found.loop_age(model.delay_frames) + model.delay_frames - 1,
        channels=tuple(row.channel for row in used),
        noise_m_s2=np.array([row.noise_m_s2 for row in used]),
    )
    motions = tuple(
        {
            row.channel: Motion(size=row.motion_nm_per_nm, phase_deg=row.phase_deg)
            for row in found.transfers
            if row.useful and row.line == line
        }
        for line in range(len(model.parts))
    )
    return fused_plant(model.plant(), SensorSuite(sensors=(instrument,)), motions)


def _open_loop_readings(
    plant: FusedPlant,
    found: AccelerometerTransfers,
    model: IdentifiedModel,
    record: LoopRecord,
    accelerations: ArrayLike,
) -> list[FloatArray]:
    """Return what all sensors of an open loop read, (frames, q), of each long stretch."""
    readings, good = fill_missing(accelerations)
    lag = found.age_frames - 1
    if found.clock_ppm:
        middle = lag + record.frames / 2
        readings, good = at_loop_rate(readings, good, 1e-6 * found.clock_ppm, middle)
    names = [row.channel for row in found.channels]
    own = readings[:, [names.index(name) for name in plant.suite.channels]]
    gains = np.array(model.sensor_gains)
    wavefront = gains * record.pseudo_open_loop(gains)
    rows = np.arange(record.frames) + lag + 1 - found.loop_age(model.delay_frames)
    known = (rows >= 0) & (rows < len(own))
    rows = np.where(known, rows, 0)
    settling = round(_SETTLING_S * model.frame_rate_hz)
    return [
        np.hstack([wavefront[a:b], own[rows[a:b]] - own[rows[a:b]].mean(axis=0)])
        for a, b in runs(record.usable & known & good[rows])
        if b - a > 2 * settling
    ]


def _power(plant: FusedPlant, series: list[FloatArray], missing: tuple[str, ...]) -> float:
    """Return the mean square that the wavefront sensor reads in the loop without some channels."""
    controller = plant.controller(fallback_gains(plant, missing))
    whole = close_fused_loop(plant.own.hardware, plant.suite, controller).system
    n, m = plant.own.hardware.modes, plant.own.hardware.n_commands
    measured = slice(n + m, n + m + plant.own.hardware.n_measurements)
    loop = StateSpace(
        A=whole.A[0], B=whole.B[0, :, n:], C=whole.C[0, measured], D=whole.D[0, measured, n:]
    )
    left = [filter_series(loop, each)[round(_SETTLING_S / plant.dt_s) :] for each in series]
    return float(np.mean(np.concatenate(left) ** 2))
