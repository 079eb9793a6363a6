"""A filter of several sensors as named arrays and plain metadata, and back."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from lbt_synth.design.fusion.failures import Fallback, failure_sets
from lbt_synth.design.fusion.fused_filter import FusedFilter, fused_name
from lbt_synth.design.record import DesignRecord, Meta, record_hardware, record_problem
from lbt_synth.models.fusion.plant import FusedPlant, fused_plant
from lbt_synth.models.fusion.sensors import (
    Accelerometer,
    Motion,
    Sensor,
    SensorSuite,
    WavefrontSensor,
)
from lbt_synth.validation import float_array, number

_CLAIMS = ("gamma_requested", "gamma_least", "gamma_infeasible", "gamma_central")
_KINDS: dict[str, type[Sensor]] = {"wavefront": WavefrontSensor, "accelerometer": Accelerometer}
_ARRAYS = ("noise_nm", "sensor_matrix", "noise_m_s2")


def record_fused(design: FusedFilter) -> DesignRecord:
    """Record gains, fall-backs and plant of a filter of several sensors."""
    plant = design.problem
    arrays = {"GAINS": design.gains}
    if design.fallbacks:
        arrays["FALLBACKS"] = np.stack([each.gains for each in design.fallbacks])
    meta: Meta = {
        "problem": "fused plant",
        "sensors": [_pack_sensor(sensor) for sensor in plant.suite.sensors],
        "motions": [
            {name: asdict(motion) for name, motion in moving.items()} for moving in plant.motions
        ],
        "fallbacks": [list(each.missing) for each in design.fallbacks],
        **{name: getattr(design, name) for name in _CLAIMS},
    }
    own = record_hardware(plant.own.hardware) | record_problem(plant.own)
    return own | DesignRecord(arrays, meta)


def rebuild_fused(record: DesignRecord) -> FusedFilter:
    """Rebuild a filter of several sensors; what it claims is computed again."""
    meta, arrays = record.meta, record.arrays
    own = DesignRecord(arrays, {**meta, "problem": "plant"}).plant("a filter of several sensors")
    suite = SensorSuite(sensors=tuple(_unpack_sensor(each) for each in meta["sensors"]))
    motions = tuple(
        {name: Motion(**motion) for name, motion in moving.items()} for moving in meta["motions"]
    )
    plant = fused_plant(own, suite, motions)
    missing = [tuple(each) for each in meta["fallbacks"]]
    if missing != failure_sets(suite.units):
        raise ValueError("fallbacks must be one for each set of sensors that may fail")
    gains = _checked(arrays["GAINS"], plant, "GAINS")
    stack = arrays["FALLBACKS"]
    if len(stack) != len(missing):
        raise ValueError(f"FALLBACKS must be {len(missing)} filters; got {len(stack)}")
    claims: dict[str, Any] = {
        k: number(meta[k], k, above=0) for k in _CLAIMS if meta[k] is not None
    }
    if meta["method"] != fused_name(claims):
        raise ValueError("the method must be that of its bound, or of none")
    return FusedFilter(
        **record.common(),
        **claims,
        problem=plant,
        gains=gains,
        fallbacks=tuple(
            Fallback(missing=some, gains=_checked(own_gains, plant, "FALLBACKS"))
            for some, own_gains in zip(missing, stack, strict=True)
        ),
    )


def _checked(gains: Any, plant: FusedPlant, name: str) -> Any:
    """Return gains of a plant's sizes that are zero where nothing is read."""
    shape = (plant.period, plant.n_states, plant.n_measurements)
    if np.shape(gains) != shape:
        raise ValueError(f"{name} must be {shape} for its plant; got {np.shape(gains)}")
    if np.any(gains * ~plant.read[:, None, :]):
        raise ValueError(f"{name} must be zero for measurements that are not read")
    return gains


def _pack_sensor(sensor: Sensor) -> Meta:
    kind = next(kind for kind, cls in _KINDS.items() if isinstance(sensor, cls))
    packed: Meta = {"kind": kind}
    for name, value in asdict(sensor).items():
        if value is not None:
            packed[name] = np.asarray(value).tolist() if name != "channels" else list(value)
    return packed


def _unpack_sensor(packed: Meta) -> Sensor:
    given = dict(packed)
    cls = _KINDS[given.pop("kind")]
    for name in _ARRAYS:
        if isinstance(given.get(name), list):
            given[name] = float_array(given[name], name)
    if "channels" in given:
        given["channels"] = tuple(given["channels"])
    return cls(**given)
