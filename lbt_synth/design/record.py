"""A design as named arrays and plain metadata, as gain files hold it, and back."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lbt_synth.design.certificate import Certificate, Check
from lbt_synth.design.result import Design, SolverReport
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.models import (
    ARModel,
    FullStatePlant,
    LoopHardware,
    PositionLoop,
    TipTiltPlant,
    Vibration,
)
from lbt_synth.validation import FloatArray, frozen_copy

Arrays = dict[str, FloatArray]
Meta = dict[str, Any]

_CHECK = ("name", "value", "limit", "computed_by")
_PROBLEMS: dict[str, type[EstimationProblem]] = {
    "problem": EstimationProblem,
    "plant": TipTiltPlant,
    "full plant": FullStatePlant,
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
        """Return what every design has, as arguments of its class."""
        return {
            "method": self.meta["method"],
            "controller": self.controller(),
            "certificate": _unpack_certificate(self.meta["certificate"]),
            "solver": SolverReport(**self.meta["solver"]),
            "assumptions": tuple(map(str, self.meta.get("assumptions", ()))),
            "configuration": str(self.meta.get("configuration", "")),
        }

    def hardware(self) -> LoopHardware:
        """Return the loop."""
        meta = self.meta
        return LoopHardware(
            frame_rate_hz=meta["frame_rate_hz"],
            delay_frames=meta["delay_frames"],
            sensor_matrix=self.arrays["SENSOR"],
            influence_matrix=self.arrays["INFLUENCE"],
            mirror=PositionLoop(**meta["mirror"]) if "mirror" in meta else None,
        )

    def problem(self) -> EstimationProblem:
        """Return the estimation problem."""
        fields: dict[str, Any] = {name: self.arrays[f"PLANT_{name}"] for name in "ABCDL"}
        fields["dt_s"] = self.meta["dt_s"]
        kind = _PROBLEMS[self.meta["problem"]]
        if kind is not EstimationProblem:
            fields["hardware"] = self.hardware()
        if kind is FullStatePlant:
            fields |= {"B_known": self.arrays["KNOWN_B"], "D_known": self.arrays["KNOWN_D"]}
        if kind is TipTiltPlant:
            fields["turbulence"] = tuple(
                ARModel(**model, frame_rate_hz=self.meta["frame_rate_hz"])
                for model in self.meta["turbulence"]
            )
            fields["vibrations"] = tuple(
                Vibration(**{**line, "direction": tuple(line["direction"])})
                for line in self.meta["vibrations"]
            )
        return kind(**fields)

    def plant(self, reason: str) -> TipTiltPlant:
        """Return the problem if it is a tip/tilt plant; TypeError with the reason if not."""
        problem = self.problem()
        if not isinstance(problem, TipTiltPlant):
            raise TypeError(f"{reason} needs a plant")
        return problem


def record_common(design: Design) -> DesignRecord:
    """Record what every design has: controller, certificate, solver and loop."""
    arrays: Arrays = {name: getattr(design.controller, name) for name in "ABCD"}
    meta: Meta = {
        "method": design.method,
        "dt_s": design.controller.dt_s,
        "solver": asdict(design.solver),
        "certificate": _pack_certificate(design.certificate),
        "units": {"commands": "1", "measurements": "1", "phase": "1"},
    }
    if design.assumptions:
        meta["assumptions"] = list(design.assumptions)
    if design.configuration:
        meta["configuration"] = design.configuration
    hardware = design.hardware
    if hardware is not None:
        arrays |= {"SENSOR": hardware.sensor, "INFLUENCE": hardware.influence}
        meta |= {"frame_rate_hz": hardware.frame_rate_hz, "delay_frames": hardware.delay_frames}
        if hardware.mirror is not None:
            meta["mirror"] = asdict(hardware.mirror)
        meta["units"] = {
            "commands": "nm rms wavefront where INFLUENCE is the identity",
            "measurements": "nm rms wavefront where SENSOR is the identity",
            "phase": "nm rms wavefront",
        }
    return DesignRecord(arrays, meta)


def record_problem(problem: EstimationProblem) -> DesignRecord:
    """Record an estimation problem, with the models that a plant is made of."""
    arrays: Arrays = {f"PLANT_{name}": getattr(problem, name) for name in "ABCDL"}
    meta: Meta = {"problem": next(k for k, kind in _PROBLEMS.items() if type(problem) is kind)}
    if isinstance(problem, FullStatePlant):
        arrays |= {"KNOWN_B": problem.B_known, "KNOWN_D": problem.D_known}
    if isinstance(problem, TipTiltPlant):
        meta["turbulence"] = [
            {"coefficients": ar.coefficients.tolist(), "driving_rms_nm": ar.driving_rms_nm}
            for ar in problem.turbulence
        ]
        meta["vibrations"] = [
            {**asdict(line), "direction": list(line.direction)} for line in problem.vibrations
        ]
    return DesignRecord(arrays, meta)


def _pack_certificate(certificate: Certificate) -> Meta:
    return {
        "gamma": None if math.isnan(certificate.gamma) else certificate.gamma,
        "rms_per_output": certificate.rms_per_output.tolist(),
        "checks": [{name: getattr(check, name) for name in _CHECK} for check in certificate.checks],
    }


def _unpack_certificate(meta: Meta) -> Certificate:
    return Certificate(
        checks=tuple(_unpack_check(check) for check in meta["checks"]),
        gamma=np.nan if meta["gamma"] is None else float(meta["gamma"]),
        rms_per_output=frozen_copy(np.array(meta["rms_per_output"], dtype=np.float64)),
    )


def _unpack_check(meta: Meta) -> Check:
    """Return a check; files of version 0.1 call ``computed_by`` ``method``."""
    values = dict(meta)
    if "method" in values:
        values["computed_by"] = values.pop("method")
    return Check(**values)
