"""A design as named arrays and plain metadata, as gain files hold it, and back."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.design.plain import from_plain, to_plain
from lbt_synth.design.result import Design, SolverReport
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.models import LoopHardware, SensorSuite, TipTiltPlant
from lbt_synth.models.plant.assembly import PlantParts
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.validation import FloatArray, frozen_copy, number, sequence, text

Arrays = dict[str, FloatArray]
Meta = dict[str, Any]

_PLANT_MODELS = ("turbulence", "vibrations", "motions")
_SHOWN = ("diameter_m", "shown_unit")  # which a design may lack
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
            ),
            "assumptions": tuple(
                text(a, "assumptions") for a in sequence(self.meta["assumptions"], "assumptions")
            ),
            "configuration": text(self.meta["configuration"], "configuration"),
            **{name: self.meta[name] for name in _SHOWN if name in self.meta},
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
        if kind is EstimationProblem:
            fields: dict[str, Any] = {name: self.arrays[f"PLANT_{name}"] for name in "ABCDL"}
            return EstimationProblem(**fields, dt_s=self.meta["dt_s"])
        models = {name: from_plain(self.meta[name]) for name in _PLANT_MODELS}
        noise_factor = self.arrays["NOISE"]
        parts = PlantParts(hardware=self.hardware(), noise_factor=noise_factor, **models)
        plant = assemble(parts)
        memory = self.arrays["PLANT_L"][:, plant.n_states :]  # of a mixed filter
        return plant.with_memory(memory) if memory.size else plant


def _claimed(value: Any, name: str) -> float | tuple[float, ...]:
    """Return a claim of a file: a number that is not negative, or one for each mode."""
    if isinstance(value, list):
        return tuple(number(part, name, at_least=0) for part in value)
    claim = number(value, name, at_least=0)
    return value if type(value) is int else claim


def _pack(name: str, value: Any) -> DesignRecord:
    """Record a field of a design; an empty array, which FITS cannot hold, is left out."""
    match value:
        case None:
            return DesignRecord()
        case np.ndarray():
            return DesignRecord({name.upper(): np.atleast_2d(value)} if value.size else {})
        case Witness():
            return DesignRecord({"WITNESS_X": value.states, "WITNESS_W": value.disturbances})
        case (Controller(), *_):
            places = enumerate(value, 1)
            arrays = {f"YOULA{i}_{key}": getattr(one, key) for i, one in places for key in "ABC"}
            return DesignRecord(arrays)
        case dict():  # of fall-backs
            gains = {name.upper(): np.stack([*value.values()])} if value else {}
            return DesignRecord(gains, {name: list(map(list, value))})
        case _:
            return DesignRecord(meta={name: to_plain(value)})


def _unpack(name: str, kind: str, record: DesignRecord) -> Any:
    """Return a field of a design, by the type that it has."""
    arrays, meta = record.arrays, record.meta
    match kind:
        case "FloatArray":
            return arrays[name.upper()]
        case "Vector":
            return frozen_copy(np.ravel(arrays.get(name.upper(), [])))
        case "Witness | None":
            if "WITNESS_X" not in arrays:
                return None
            return Witness(states=arrays["WITNESS_X"], disturbances=arrays["WITNESS_W"])
        case "tuple[Controller, ...]":
            count = sum(key.startswith("YOULA") and key.endswith("_A") for key in arrays)
            parameters = []
            for place in range(1, count + 1):
                A, B, C = (arrays[f"YOULA{place}_{key}"] for key in "ABC")
                D = np.zeros((len(C), B.shape[1]))
                parameters.append(Controller(A=A, B=B, C=C, D=D, dt_s=meta["dt_s"]))
            return tuple(parameters)
        case "Fallbacks":
            gains = arrays[name.upper()] if meta[name] else ()
            if len(gains) != len(meta[name]):
                raise ValueError(f"{name.upper()} must be {len(meta[name])} filters")
            return dict(zip(map(tuple, meta[name]), map(frozen_copy, gains), strict=True))
        case "tuple[float, ...]":
            return tuple(number(value, name, above=0) for value in meta[name])
        case _:
            return from_plain(meta[name])


def _own_fields(kind: type[Design]) -> dict[str, str]:
    """Return the fields, with their types, that a kind of design has beyond every design's."""
    common = {part.name for part in fields(Design)}
    return {part.name: str(part.type) for part in fields(kind) if part.name not in common}


def rebuild_design(kind: type[Design], record: DesignRecord) -> Design:
    """Make a design of a kind from its record, without a certificate."""
    stored = {name: _unpack(name, hint, record) for name, hint in _own_fields(kind).items()}
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
        **{name: value for name in _SHOWN if (value := getattr(design, name)) is not None},
    }
    record = DesignRecord(arrays, meta)
    if design.hardware is not None:
        record |= _record_hardware(design.hardware)
    for name in _own_fields(type(design)):
        record |= _pack(name, getattr(design, name))
    problem = design.problem
    names = {kind: name for name, kind in _PROBLEMS.items()}
    record |= DesignRecord(meta={"problem": names[type(problem)]})
    if not isinstance(problem, LoopHardware):
        record |= DesignRecord({f"PLANT_{name}": getattr(problem, name) for name in "ABCDL"})
    if isinstance(problem, TipTiltPlant):
        models = {name: to_plain(getattr(problem, name)) for name in _PLANT_MODELS}
        record |= DesignRecord({"NOISE": problem.own_noise_factor}, models)
    return record


def _record_hardware(hardware: LoopHardware) -> DesignRecord:
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


def certificate_record(certificate: Certificate) -> list[Meta]:
    """Return the checks of a certificate as plain metadata."""
    return [{name: getattr(check, name) for name in _CHECK} for check in certificate.checks]
