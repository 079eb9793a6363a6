"""The methods of synthesis in one table, each found by its name."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from lbt_synth.errors import ProblemError
from lbt_synth.methods.method import DesignInputs, Method, Section
from lbt_synth.methods.robust import ROBUST

if TYPE_CHECKING:
    from lbt_synth.design.integrator import IntegratorDesign
    from lbt_synth.design.result import Design

_FILTER = "lbt_synth.design.filter_design:FilterDesign"
_BOUNDS = frozenset({"gamma", "gamma_ratio"})  # at most one is given
_SIZES = {"gain", "phase_margin_deg", "modulus_margin"}  # what decides the gain of an integrator


class KalmanOptions(Section):
    """Options of the Kalman filter."""

    route: Literal["riccati", "sdp"] = Field(
        default="riccati", description="solver, riccati or sdp"
    )


class BoundOptions(Section):
    """A bound on the H-infinity norm."""

    gamma: float | None = Field(default=None, gt=0, description="bound of the H-infinity norm [nm]")
    gamma_ratio: float = Field(
        default=1.2,
        ge=1,
        le=1e9,
        description="bound of the norm as a multiple of the least norm",
        json_schema_extra={
            "hint": "At 1 the bound is the least one; far above it the filter is the Kalman "
            "filter.",
        },
    )

    def arguments(self) -> dict[str, Any]:
        """Return the options of which one is the bound: an absolute one, else the multiple."""
        values = self.model_dump()
        del values["gamma" if self.gamma is None else "gamma_ratio"]
        return values


class HinfOptions(BoundOptions):
    """Options of the H-infinity filter."""

    route: Literal["lmi", "riccati"] | None = Field(
        default=None, description="solver (default lmi up to 20 states, riccati beyond)"
    )


class MixedOptions(BoundOptions):
    """Options of the mixed filter."""

    taps: int = Field(
        default=16, ge=1, le=64, description="past innovations that the filter weighs"
    )


class LqgOptions(Section):
    """Options of the LQG controller."""

    command_weight: float = Field(
        default=0.0,
        ge=0,
        le=1e12,
        description="weight of the squared command beside the squared residual",
    )


class IntegratorOptions(Section):
    """Options of the integrator."""

    gain: float | None = Field(
        default=None,
        ge=1e-3,
        le=1e3,
        description="its gain (default: the best for the truth that keeps the margins)",
    )
    phase_margin_deg: float | None = Field(
        default=None, gt=0, lt=180, description="least phase margin [deg]", examples=[45]
    )
    modulus_margin: float | None = Field(
        default=None, gt=0, lt=1, description="least modulus margin", examples=[0.5]
    )
    leak: float = Field(
        default=1.0, gt=0, le=1, description="part of a command that is left after a frame"
    )
    integrators: int = Field(
        default=1, ge=1, le=2, description="how many in series; two need a zero"
    )
    zero_hz: float | None = Field(
        default=None,
        ge=1e-3,
        le=1e6,
        description="corner of a zero [Hz]: of a PI controller, or of the lag compensator of a "
        "double integrator",
    )


def _filter_of(synthesis: str) -> Callable[[DesignInputs, Any], Design]:
    """Return how a function "module:name" designs for the plant of the inputs."""

    def build(inputs: DesignInputs, options: Any) -> Design:
        design: Design = resolve_name(synthesis)(inputs.plant, **options.arguments())
        return design

    return build


def _build_lqg(inputs: DesignInputs, options: LqgOptions) -> Design:
    from lbt_synth.design.lqg import lqg

    return lqg(inputs.plant.own_sensor_alone(), **options.arguments())


def _build_integrator(inputs: DesignInputs, options: IntegratorOptions) -> IntegratorDesign:
    from lbt_synth.design.integrator import IntegratorLaw, integrator

    section: IntegratorOptions | None = inputs.defaults.get(INTEGRATOR.name)
    chosen = options.model_dump(exclude_unset=True)
    usual = {} if section is None else section.model_dump(exclude_unset=True)
    if chosen.keys() & _SIZES:
        usual = {name: value for name, value in usual.items() if name not in _SIZES}
    values = usual | chosen
    gain = values.pop("gain", None)
    truth = inputs.truth if gain is None else None
    return integrator(inputs.plant.hardware, gain=gain, truth=truth, law=IntegratorLaw(**values))


def _build_predictor(inputs: DesignInputs, options: Section) -> Design:
    if inputs.predict is None:
        raise ProblemError(
            "the method predictor is made of a record; got a plant or a configuration alone.",
            in_python="Try design_from_record(record, method='predictor').",
            at_terminal="Try lbt-synth auto RECORD --method predictor.",
        )
    return inputs.predict()


KALMAN = Method(
    name="kalman",
    title="Kalman filter",
    label="Kalman",
    design=_FILTER,
    options=KalmanOptions,
    build=_filter_of("lbt_synth.design.kalman:kalman"),
    batched=True,
    reference_rank=1,
)
HINF = Method(
    name="hinf",
    title="H-infinity filter",
    label="H∞",
    design=_FILTER,
    options=HinfOptions,
    build=_filter_of("lbt_synth.design.hinf:hinf"),
    exclusive=_BOUNDS,
    configurable=frozenset({"gamma_ratio"}),
    reference_rank=2,
    reference_options={"route": "riccati"},
)
MIXED = Method(
    name="mixed",
    title="mixed filter",
    label="mixed",
    design=_FILTER,
    options=MixedOptions,
    build=_filter_of("lbt_synth.design.mixed:mixed"),
    exclusive=_BOUNDS,
    configurable=frozenset({"gamma_ratio"}),
    slow=True,
)
LQG = Method(
    name="lqg",
    title="LQG controller",
    label="LQG",
    options=LqgOptions,
    build=_build_lqg,
    design="lbt_synth.design.lqg:LqgDesign",
    configurable=frozenset({"command_weight"}),
)
INTEGRATOR = Method(
    name="integrator",
    title="integrator",
    label="integrator",
    options=IntegratorOptions,
    section=IntegratorOptions,
    build=_build_integrator,
    design="lbt_synth.design.integrator:IntegratorDesign",
    estimator=False,
    reference_rank=0,
    compared_options={"phase_margin_deg": 45.0},  # one that a telescope would run
)
PREDICTOR = Method(
    name="predictor",
    title="least-squares predictor",
    label="predictor",
    options=Section,
    build=_build_predictor,
    design="lbt_synth.design.predictor:PredictorDesign",
    estimator=False,
    of_record=True,
)
_ALL = HINF, INTEGRATOR, KALMAN, LQG, MIXED, PREDICTOR, ROBUST
METHODS = {method.name: method for method in _ALL}


def method_named(name: str) -> Method:
    """Return a method by its name; refuse a name that none has."""
    if name not in METHODS:
        close = difflib.get_close_matches(name, METHODS, n=1)
        hint = f" Did you mean {close[0]}?" if close else ""
        raise ProblemError(f"method must be one of {', '.join(METHODS)}; got {name!r}.{hint}")
    return METHODS[name]


def option_names() -> list[str]:
    """Return the names of the options of all methods."""
    return sorted({name for m in METHODS.values() for name in m.options.model_fields})


def design_title(name: str) -> str:
    """Return what sentences call a design with a name in ``Design.method``, else the name."""
    return METHODS[name].title if name in METHODS else name


def design_label(name: str) -> str:
    """Return what figures call a design with a name in ``Design.method``, else the name."""
    return METHODS[name].label if name in METHODS else name


def record_methods() -> list[str]:
    """Return the names of the methods that need no more than a record, and its model."""
    usable = [m for m in METHODS.values() if m.estimator or m.of_record]
    return [m.name for m in usable if not m.needs_options]


def default_method() -> str:
    """Return the name of the method that is designed unless another is named."""
    return reference_methods(estimators_only=True)[0].name


def reference_methods(*, estimators_only: bool = False) -> list[Method]:
    """Return the methods that studies compare designs with, in their order."""
    ranked = [
        (method.reference_rank, method.name, method)
        for method in METHODS.values()
        if method.reference_rank is not None and (method.estimator or not estimators_only)
    ]
    return [method for *_, method in sorted(ranked, key=lambda entry: entry[:2])]
