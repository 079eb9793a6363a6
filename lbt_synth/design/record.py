"""A design as named arrays and plain metadata, as gain files hold it, and back."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.design.result import UNCERTIFIED, Design, SolverReport
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.models import (
    ARModel,
    FullStatePlant,
    LoopHardware,
    PositionLoop,
    TipTiltPlant,
    Vibration,
)
from lbt_synth.models.plant.parts import PlantParts, held_frames
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.validation import FloatArray, integer, sequence, text

Arrays = dict[str, FloatArray]
Meta = dict[str, Any]

_SAME = 1e-9
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
        """Return what every design has, as arguments of its class; it is not certified yet."""
        solver = self.meta["solver"]
        return {
            "method": self.meta["method"],
            "certificate": UNCERTIFIED,
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
            mirror=PositionLoop(**meta["mirror"]) if "mirror" in meta else None,
        )

    def problem(self) -> EstimationProblem:
        """Return the estimation problem; that of a plant is assembled from its parts."""
        kind = _PROBLEMS[self.meta["problem"]]
        if kind is TipTiltPlant:
            return self._assembled_plant()
        fields: dict[str, Any] = {name: self.arrays[f"PLANT_{name}"] for name in "ABCDL"}
        fields["dt_s"] = self.meta["dt_s"]
        if kind is FullStatePlant:
            fields |= {"B_known": self.arrays["KNOWN_B"], "D_known": self.arrays["KNOWN_D"]}
            plant = FullStatePlant(**fields, hardware=self.hardware())
            _require_own_loop(plant)
            return plant
        return kind(**fields)

    def _assembled_plant(self) -> EstimationProblem:
        """Return the plant of loop, turbulence, vibrations and noise, with a filter's memory."""
        hardware, meta = self.hardware(), self.meta
        parts = PlantParts(
            hardware=hardware,
            turbulence=tuple(
                ARModel(**model, frame_rate_hz=hardware.frame_rate_hz)
                for model in meta["turbulence"]
            ),
            vibrations=tuple(
                Vibration(**{**line, "direction": tuple(line["direction"])})
                for line in meta["vibrations"]
            ),
            noise_factor=self.arrays["PLANT_D"][:, -hardware.n_measurements :],
        )
        memory = self.arrays["PLANT_L"][:, parts.size :]
        plant = assemble(parts)
        return plant.with_memory(memory) if memory.size else plant

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
        "assumptions": list(design.assumptions),
        "configuration": design.configuration,
    }
    record = DesignRecord(arrays, meta)
    return record if design.hardware is None else record | record_hardware(design.hardware)


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
    if hardware.mirror is not None:
        meta["mirror"] = asdict(hardware.mirror)
    return DesignRecord({"SENSOR": hardware.sensor, "INFLUENCE": hardware.influence}, meta)


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


def _require_own_loop(plant: FullStatePlant) -> None:
    """Refuse a plant whose commands or sensor are not those of its loop.

    The response of y to a command is that of the hardware; and as y sees the phase ``h + 1``
    frames after ``L x`` reaches it, ``S L A^i B = (1-f) C A^(i+h) B + f C A^(i+h-1) B``, with f the
    weight of the frame before.
    """
    hardware, n = plant.hardware, plant.n_states
    mirror, response = hardware.mirror_system.whole, -hardware.sensor @ hardware.influence
    held = held_frames(hardware)
    late = held + 1 - hardware.delay_frames
    known, entry, state = plant.B_known, plant.B, mirror.B
    seen, estimated = [], []
    pairs = [(plant.D_known, mirror.D * response)]
    for _ in range(n + held):
        pairs.append((plant.C @ known, mirror.C @ state * response))
        seen.append(plant.C @ entry)
        estimated.append(hardware.sensor @ plant.L @ entry)
        known, entry, state = plant.A @ known, plant.A @ entry, mirror.A @ state
    before = [np.zeros_like(seen[0]), *seen]
    pairs += [(seen[i], before[0]) for i in range(held)]
    pairs += [
        ((1 - late) * seen[i + held] + late * before[i + held], estimated[i]) for i in range(n)
    ]
    found, expected = (np.concatenate([np.ravel(pair[i]) for pair in pairs]) for i in (0, 1))
    if not np.allclose(found, expected, rtol=_SAME, atol=_SAME * np.max(np.abs(expected))):
        raise ValueError("the plant does not respond to its loop's commands and phase")
