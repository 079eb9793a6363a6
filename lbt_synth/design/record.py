"""A design as named arrays and plain metadata, as gain files hold it, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.design.filter_design import Fallback
from lbt_synth.design.plain import from_plain, to_plain
from lbt_synth.design.result import Design, SolverReport
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.models import LoopHardware, SensorSuite, TipTiltPlant
from lbt_synth.models.plant.assembly import PlantParts
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.validation import (
    FloatArray,
    frozen_copy,
    integer,
    number,
    sequence,
    text,
)

Arrays = dict[str, FloatArray]
Meta = dict[str, Any]

_PLANT_MODELS = ("turbulence", "vibrations", "motions")
_CHECK = ("name", "value", "limit", "computed_by")
_PROBLEMS: dict[str, type[EstimationProblem | LoopHardware]] = {
    "problem": EstimationProblem,
    "plant": TipTiltPlant,
    "loop": LoopHardware,
}


@dataclass(frozen=True, slots=True, eq=False)
class DesignRecord:
    """Named arrays and plain metadata; missing names raise KeyError."""

    arrays: Arrays = field(default_factory=dict)
    meta: Meta = field(default_factory=dict)

    def __or__(self, other: DesignRecord) -> DesignRecord:
        """Join two records."""
        return DesignRecord(self.arrays | other.arrays, self.meta | other.meta)

    def controller(self, prefix: str = "", D: FloatArray | None = None) -> Controller:
        """Return the controller of the arrays with a prefix; D may be given."""
        names = "ABCD" if D is None else "ABC"
        given = {} if D is None else {"D": D}
        arrays = {name: self.arrays[f"{prefix}{name}"] for name in names}
        return Controller(**arrays, **given, dt_s=self.meta["dt_s"])

    def common(self) -> dict[str, Any]:
        """Return what every design has, as arguments of its class; it is not certified yet."""
        solver, claims = self.meta["solver"], self.meta["claims"]
        return {
            "method": self.meta["method"],
            "problem": self.problem(),
            "claims": {name: _claimed(value, name) for name, value in claims.items()},
            "solver": SolverReport(
                route=text(solver["route"], "route"),
                status=text(solver["status"], "status"),
                iterations=integer(solver["iterations"], "iterations", at_least=0),
            ),
            "assumptions": tuple(
                text(a, "assumptions") for a in sequence(self.meta["assumptions"], "assumptions")
            ),
            "configuration": text(self.meta["configuration"], "configuration"),
        }

    def hardware(self) -> LoopHardware:
        """Return the loop."""
        meta = self.meta
        return LoopHardware(
            frame_rate_hz=meta["frame_rate_hz"],
            delay_frames=meta["delay_frames"],
            sensor_matrix=self.arrays["SENSOR"],
            influence_matrix=self.arrays["INFLUENCE"],
            mirror=from_plain(meta.get("mirror")),
            suite=SensorSuite(sensors=from_plain(meta["sensors"])),
        )

    def problem(self) -> EstimationProblem | LoopHardware:
        """Return what the design is for; a plant is assembled from its parts."""
        kind = _PROBLEMS[self.meta["problem"]]
        if kind is LoopHardware:
            return self.hardware()
        if kind is not EstimationProblem:
            return self._assembled_plant()
        fields: dict[str, Any] = {name: self.arrays[f"PLANT_{name}"] for name in "ABCDL"}
        return EstimationProblem(**fields, dt_s=self.meta["dt_s"])

    def _assembled_plant(self) -> TipTiltPlant:
        """Return the plant of loop, turbulence, vibrations and noise, with a filter's memory."""
        models = {name: from_plain(self.meta[name]) for name in _PLANT_MODELS}
        noise_factor = self.arrays["NOISE"]
        parts = PlantParts(hardware=self.hardware(), noise_factor=noise_factor, **models)
        plant = assemble(parts)
        memory = self.arrays["PLANT_L"][:, plant.n_states :]
        return plant.with_memory(memory) if memory.size else plant


def _claimed(value: Any, name: str) -> float | tuple[float, ...]:
    """Return a claim of a file: a number that is not negative, or one for each mode."""
    if isinstance(value, list):
        return tuple(number(part, name, at_least=0) for part in value)
    claim = number(value, name, at_least=0)
    return value if type(value) is int else claim


class _Codec(NamedTuple):
    """How a field of a design stands in a record: packed under its name, and back."""

    pack: Callable[[str, Any], DesignRecord]
    unpack: Callable[[str, DesignRecord], Any]


def _pack_array(name: str, array: FloatArray) -> DesignRecord:
    """Record an array; an empty one, which FITS cannot hold, is left out."""
    return DesignRecord({name.upper(): np.atleast_2d(array)} if array.size else {})


def _pack_parameters(name: str, parameters: tuple[Controller, ...]) -> DesignRecord:
    arrays = {
        f"YOULA{mode + 1}_{letter}": getattr(parameter, letter)
        for mode, parameter in enumerate(parameters)
        for letter in "ABC"
    }
    return DesignRecord(arrays)


def _unpack_parameters(name: str, record: DesignRecord) -> tuple[Controller, ...]:
    arrays = record.arrays
    count = sum(key.startswith("YOULA") and key.endswith("_A") for key in arrays)
    prefixes = [f"YOULA{place + 1}_" for place in range(count)]
    sizes = [(len(arrays[f"{at}C"]), arrays[f"{at}B"].shape[1]) for at in prefixes]
    pairs = zip(prefixes, sizes, strict=True)
    return tuple(record.controller(prefix, D=np.zeros(size)) for prefix, size in pairs)


def _pack_witness(name: str, witness: Witness | None) -> DesignRecord:
    if witness is None:
        return DesignRecord()
    return DesignRecord({"WITNESS_X": witness.states, "WITNESS_W": witness.disturbances})


def _unpack_witness(name: str, record: DesignRecord) -> Witness | None:
    arrays = record.arrays
    if "WITNESS_X" not in arrays:
        return None
    return Witness(states=arrays["WITNESS_X"], disturbances=arrays["WITNESS_W"])


def _pack_fallbacks(name: str, fallbacks: tuple[Fallback, ...]) -> DesignRecord:
    arrays = {name.upper(): np.stack([f.gains for f in fallbacks])} if fallbacks else {}
    return DesignRecord(arrays, {name: [list(fallback.missing) for fallback in fallbacks]})


def _unpack_fallbacks(name: str, record: DesignRecord) -> tuple[Fallback, ...]:
    missing = record.meta[name]
    gains = record.arrays[name.upper()] if missing else ()
    if len(gains) != len(missing):
        raise ValueError(f"{name.upper()} must be {len(missing)} filters; got {len(gains)}")
    return tuple(
        Fallback(missing=tuple(sensors), gains=frozen_copy(gain))
        for sensors, gain in zip(missing, gains, strict=True)
    )


_CODECS = {  # by the type of the field
    "FloatArray": _Codec(_pack_array, lambda name, record: record.arrays[name.upper()]),
    "Vector": _Codec(
        _pack_array, lambda name, record: frozen_copy(np.ravel(record.arrays.get(name.upper(), [])))
    ),
    "Witness | None": _Codec(_pack_witness, _unpack_witness),
    "tuple[Fallback, ...]": _Codec(_pack_fallbacks, _unpack_fallbacks),
    "tuple[Controller, ...]": _Codec(_pack_parameters, _unpack_parameters),
    "tuple[Specification, ...]": _Codec(
        lambda name, specifications: DesignRecord(meta={name: to_plain(specifications)}),
        lambda name, record: from_plain(record.meta[name]),
    ),
    "tuple[float, ...]": _Codec(
        lambda name, values: DesignRecord(meta={name: list(values)}),
        lambda name, record: tuple(number(v, name, above=0) for v in record.meta[name]),
    ),
    "int": _Codec(
        lambda name, value: DesignRecord(meta={name: value}),
        lambda name, record: integer(record.meta[name], name),
    ),
}


def _stored_fields(kind: type[Design]) -> Iterator[tuple[str, _Codec]]:
    """Yield the fields that a kind of design has beyond those of every design."""
    common = {part.name for part in fields(Design)}
    return ((f.name, _CODECS[str(f.type)]) for f in fields(kind) if f.name not in common)


def rebuild_design(kind: type[Design], record: DesignRecord) -> Design:
    """Make a design of a kind from its record, without a certificate."""
    stored = {name: codec.unpack(name, record) for name, codec in _stored_fields(kind)}
    return kind(**record.common(), **stored)


def record_design(design: Design) -> DesignRecord:
    """Record a design: controller, problem, arrays, claims, certificate and solver."""
    arrays: Arrays = {name: getattr(design.controller, name) for name in "ABCD"}
    claims = design.claims
    meta: Meta = {
        "method": design.method,
        "dt_s": design.controller.dt_s,
        "solver": asdict(design.solver),
        "claims": {n: list(v) if isinstance(v, tuple) else v for n, v in claims.items()},
        "certificate": certificate_record(design.certificate),
        "units": {"commands": "1", "measurements": "1", "phase": "1"},
        "assumptions": list(design.assumptions),
        "configuration": design.configuration,
    }
    record = DesignRecord(arrays, meta)
    if design.hardware is not None:
        record |= record_hardware(design.hardware)
    for name, codec in _stored_fields(type(design)):
        record |= codec.pack(name, getattr(design, name))
    return record | record_problem(design.problem)


def record_hardware(hardware: LoopHardware) -> DesignRecord:
    """Record a loop."""
    taps = hardware.mirror_taps
    meta: Meta = {
        "frame_rate_hz": hardware.frame_rate_hz,
        "delay_frames": hardware.delay_frames,
        "mean_delay_frames": 1 + float(np.arange(taps.size) @ taps),
        "units": {
            "commands": "nm rms wavefront where INFLUENCE is the identity",
            "measurements": "nm rms wavefront where SENSOR is the identity",
            "phase": "nm rms wavefront",
        },
    }
    meta["sensors"] = to_plain(hardware.suite.sensors)
    if hardware.mirror is not None:
        meta["mirror"] = to_plain(hardware.mirror)
    return DesignRecord({"SENSOR": hardware.sensor, "INFLUENCE": hardware.influence}, meta)


def record_problem(problem: EstimationProblem | LoopHardware) -> DesignRecord:
    """Record an estimation problem, with the models that a plant is made of; or a loop alone."""
    meta: Meta = {"problem": next(k for k, kind in _PROBLEMS.items() if type(problem) is kind)}
    if problem is getattr(problem, "hardware", None):
        return DesignRecord(meta=meta)
    arrays: Arrays = {f"PLANT_{name}": getattr(problem, name) for name in "ABCDL"}
    plant = problem if isinstance(problem, TipTiltPlant) else None
    if plant is not None:
        meta |= {name: to_plain(getattr(plant, name)) for name in _PLANT_MODELS}
        arrays["NOISE"] = plant.own_noise_factor
    return DesignRecord(arrays, meta)


def certificate_record(certificate: Certificate) -> list[Meta]:
    """Return the checks of a certificate as plain metadata."""
    return [{name: getattr(check, name) for name in _CHECK} for check in certificate.checks]
