"""What a gain file holds: a design as named arrays and plain metadata, and back."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import (
    Certificate,
    Check,
    Design,
    EstimatorDesign,
    FilterDesign,
    IntegratorDesign,
    LqgDesign,
    PolytopicDesign,
    ShapedDesign,
    SolverReport,
)
from lbt_synth.design.shaping import Specification
from lbt_synth.design.shaping.metadata import from_metadata, to_metadata
from lbt_synth.linear import Controller, EstimationProblem, Witness
from lbt_synth.models import (
    ARModel,
    FullStatePlant,
    LoopHardware,
    PositionLoop,
    TipTiltPlant,
    Vibration,
)
from lbt_synth.validation import FloatArray, choice, frozen_copy, number

SCHEMA = "lbt_synth gain file"
SCHEMA_VERSION = 1
CONVENTION = (
    "x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k): the output is read from the new state. "
    "y(k) = SENSOR phi_res(k-1) + noise; phi_cor(k) = INFLUENCE u(k-delay_frames+1), or the "
    "mirror's exposure-averaged answer to these commands where META holds a mirror. "
    "GAIN_PREDICTOR: x(k+1|k) = A x(k|k-1) + G (y - C x(k|k-1)); "
    "GAIN_FILTER: x(k|k) = x(k|k-1) + G (y - C x(k|k-1)); A, B, C, D, L of the plant in PLANT_*."
)
Arrays = dict[str, FloatArray]
Meta = dict[str, Any]

_FILTER_CLAIMS = ("gamma_requested", "gamma_least", "gamma_infeasible", "rms_requested")
_SIZES = ("bound_guaranteed", "worst_achieved", "worst_frequency_hz", "bound_programme")
_PROBLEMS: dict[str, type[EstimationProblem]] = {
    "problem": EstimationProblem,
    "plant": TipTiltPlant,
    "full plant": FullStatePlant,
}


def pack_design(design: Design) -> tuple[Arrays, Meta]:
    """Return the arrays and the metadata of a design."""
    arrays: Arrays = {name: getattr(design.controller, name) for name in "ABCD"}
    meta: Meta = {
        "library_version": lbt_synth.__version__,
        "method": design.method,
        "convention": CONVENTION,
        "dt_s": design.controller.dt_s,
        "solver": {n: getattr(design.solver, n) for n in ("route", "status", "iterations")},
        "certificate": _pack_certificate(design.certificate),
        "units": {"commands": "1", "measurements": "1", "phase": "1"},
    }
    if design.hardware is not None:
        arrays |= {"SENSOR": design.hardware.sensor, "INFLUENCE": design.hardware.influence}
        meta["frame_rate_hz"] = design.hardware.frame_rate_hz
        meta["delay_frames"] = design.hardware.delay_frames
        if design.hardware.mirror is not None:
            meta["mirror"] = asdict(design.hardware.mirror)
        meta["units"] = {
            "commands": "nm rms wavefront where INFLUENCE is the identity",
            "measurements": "nm rms wavefront where SENSOR is the identity",
            "phase": "nm rms wavefront",
        }
    if isinstance(design, IntegratorDesign):
        meta["integrator_gain"] = design.gain
    if isinstance(design, ShapedDesign):
        for mode, parameter in enumerate(design.parameters):
            arrays |= {f"YOULA{mode + 1}_{n}": getattr(parameter, n) for n in "ABC"}
        meta["shaped"] = {
            "specifications": [to_metadata(spec) for spec in design.specifications],
            "objective_nm": list(design.objective_nm),
            "long_objective_nm": list(design.long_objective_nm),
            "long_functions": design.long_functions,
        }
    if isinstance(design, FilterDesign):
        arrays |= {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_FILTER": design.gain_filter}
        meta |= {name: getattr(design, name) for name in _FILTER_CLAIMS}
        if design.witness is not None:
            arrays["WITNESS_X"] = design.witness.states
            arrays["WITNESS_W"] = design.witness.disturbances
    if isinstance(design, PolytopicDesign):
        arrays |= {f"PREDICTOR_{name}": getattr(design.predictor, name) for name in "ABC"}
        meta["interval"] = {
            name: getattr(design, name) for name in ("half_width_hz", "norm", *_SIZES)
        }
    if isinstance(design, LqgDesign):
        arrays |= {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_STATE": design.gain_state}
        if design.gain_mirror.size:
            arrays["GAIN_MIRROR"] = design.gain_mirror[None]
        meta["lqg"] = {name: getattr(design, name) for name in ("command_weight", "objective_nm")}
    if isinstance(design, EstimatorDesign):
        _pack_problem(design.problem, arrays, meta)
    return arrays, meta


def unpack_design(arrays: Arrays, meta: Meta) -> Design:
    """Rebuild a design; missing keys raise KeyError, wrong sizes a ProblemError."""
    common: dict[str, Any] = {
        "method": meta["method"],
        "controller": Controller(**{name: arrays[name] for name in "ABCD"}, dt_s=meta["dt_s"]),
        "certificate": _unpack_certificate(meta["certificate"]),
        "solver": SolverReport(**meta["solver"]),
    }
    if meta["method"] == "integrator":
        return IntegratorDesign(
            **common, loop_hardware=_unpack_hardware(arrays, meta), gain=meta["integrator_gain"]
        )
    if "shaped" in meta:
        return _unpack_shaped(arrays, meta, common)
    problem = _unpack_problem(arrays, meta)
    if "interval" in meta:
        return _unpack_polytopic(common, problem, arrays, meta["interval"])
    if "lqg" in meta:
        return _unpack_lqg(common, problem, arrays, meta["lqg"])
    rows_cols = (problem.A.shape[0], problem.C.shape[0])
    for name in ("GAIN_PREDICTOR", "GAIN_FILTER"):
        if arrays[name].shape != rows_cols:
            raise ValueError(f"{name} must be {rows_cols} to match the plant")
    return FilterDesign(
        **common,
        problem=problem,
        gain_predictor=arrays["GAIN_PREDICTOR"],
        gain_filter=arrays["GAIN_FILTER"],
        gamma_requested=meta["gamma_requested"],
        gamma_least=meta["gamma_least"],
        rms_requested=meta.get("rms_requested"),
        gamma_infeasible=meta.get("gamma_infeasible"),  # files of 0.1 have none, nor a witness
        witness=Witness(states=arrays["WITNESS_X"], disturbances=arrays["WITNESS_W"])
        if "WITNESS_X" in arrays
        else None,
    )


def _unpack_shaped(arrays: Arrays, meta: Meta, common: Meta) -> ShapedDesign:
    hardware, shaped = _unpack_hardware(arrays, meta), meta["shaped"]
    parameters = tuple(
        Controller(
            **{n: arrays[f"YOULA{mode + 1}_{n}"] for n in "ABC"},
            D=np.zeros((1, 1)),
            dt_s=meta["dt_s"],
        )
        for mode in range(hardware.modes)
    )
    specifications = tuple(from_metadata(spec) for spec in shaped["specifications"])
    if not all(isinstance(spec, Specification) for spec in specifications):
        raise ValueError("what it holds as specifications are none")
    for spec in specifications:
        spec.require_fitting(hardware.frame_rate_hz)
    objective, long = (
        tuple(number(v, name, above=0) for v in shaped[name])
        for name in ("objective_nm", "long_objective_nm")
    )
    if {len(specifications), len(objective), len(long)} != {hardware.modes}:
        raise ValueError(
            f"it must have {hardware.modes} specifications and claims, one for each mode"
        )
    return ShapedDesign(
        **common,
        loop_hardware=hardware,
        specifications=specifications,
        parameters=parameters,
        objective_nm=objective,
        long_objective_nm=long,
        long_functions=int(shaped["long_functions"]),
    )


def _unpack_polytopic(
    common: dict[str, Any], problem: EstimationProblem, arrays: Arrays, interval: Meta
) -> PolytopicDesign:
    if not isinstance(problem, TipTiltPlant):
        raise TypeError("an interval of frequencies needs a plant")
    if common["method"] != f"polytopic-{interval['norm']}":
        raise ValueError(f"the method {common['method']} is not of the norm {interval['norm']}")
    sizes: dict[str, Any] = {name: number(interval[name], name, above=0) for name in _SIZES}
    design = PolytopicDesign(
        **common,
        **sizes,
        problem=problem,
        predictor=Controller(
            **{name: arrays[f"PREDICTOR_{name}"] for name in "ABC"},
            D=np.zeros((len(problem.L), len(problem.C))),
            dt_s=problem.dt_s,
        ),
        norm=choice(interval["norm"], "norm", ("hinf", "h2")),
        half_width_hz=number(interval["half_width_hz"], "half_width_hz", at_least=0),
    )
    # an interval that does not fit the plant is refused here, not when it is verified
    design.interval.coefficient(design.worst_frequency_hz)
    return design


def _unpack_lqg(
    common: dict[str, Any], problem: EstimationProblem, arrays: Arrays, lqg: Meta
) -> LqgDesign:
    if not isinstance(problem, TipTiltPlant):
        raise TypeError("a design that knows the mirror needs a plant")
    design = LqgDesign(
        **common,
        problem=problem,
        gain_predictor=arrays["GAIN_PREDICTOR"],
        gain_state=arrays["GAIN_STATE"],
        gain_mirror=frozen_copy(np.ravel(arrays.get("GAIN_MIRROR", []))),
        command_weight=number(lqg["command_weight"], "command_weight", at_least=0),
        objective_nm=number(lqg["objective_nm"], "objective_nm", at_least=0),
    )
    estimation, mirror = design.estimation, problem.hardware.mirror_system.core
    shapes = {
        "GAIN_PREDICTOR": (design.gain_predictor.shape, estimation.C.T.shape),
        "GAIN_STATE": (design.gain_state.shape, estimation.L.shape),
        "GAIN_MIRROR": (design.gain_mirror.shape, (mirror.n_states,)),
    }
    for name, (found, expected) in shapes.items():
        if found != expected:
            raise ValueError(f"{name} must be {expected} to match the plant and the mirror")
    return design


def _pack_problem(problem: EstimationProblem, arrays: Arrays, meta: Meta) -> None:
    for name in "ABCDL":
        arrays[f"PLANT_{name}"] = getattr(problem, name)
    meta["problem"] = next(key for key, kind in _PROBLEMS.items() if type(problem) is kind)
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


def _unpack_problem(arrays: Arrays, meta: Meta) -> EstimationProblem:
    fields: dict[str, Any] = {name: arrays[f"PLANT_{name}"] for name in "ABCDL"}
    fields["dt_s"] = meta["dt_s"]
    kind = _PROBLEMS[meta["problem"]]
    if kind is not EstimationProblem:
        fields["hardware"] = _unpack_hardware(arrays, meta)
    if kind is FullStatePlant:
        fields |= {"B_known": arrays["KNOWN_B"], "D_known": arrays["KNOWN_D"]}
    if kind is TipTiltPlant:
        fields["turbulence"] = tuple(
            ARModel(**model, frame_rate_hz=meta["frame_rate_hz"]) for model in meta["turbulence"]
        )
        fields["vibrations"] = tuple(
            Vibration(**{**line, "direction": tuple(line["direction"])})
            for line in meta["vibrations"]
        )
    return kind(**fields)


def _unpack_hardware(arrays: Arrays, meta: Meta) -> LoopHardware:
    return LoopHardware(
        frame_rate_hz=meta["frame_rate_hz"],
        delay_frames=meta["delay_frames"],
        sensor_matrix=arrays["SENSOR"],
        influence_matrix=arrays["INFLUENCE"],
        mirror=PositionLoop(**meta["mirror"]) if "mirror" in meta else None,
    )


def _pack_certificate(certificate: Certificate) -> Meta:
    return {
        "gamma": None if math.isnan(certificate.gamma) else certificate.gamma,
        "rms_per_output": certificate.rms_per_output.tolist(),
        "checks": [
            {"name": c.name, "value": c.value, "limit": c.limit, "computed_by": c.computed_by}
            for c in certificate.checks
        ],
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
