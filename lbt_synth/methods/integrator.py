"""The method of the classical integrator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import Field

from lbt_synth.methods.method import Description, DesignInputs, Method, Section
from lbt_synth.validation import number

if TYPE_CHECKING:
    from lbt_synth.design.integrator import IntegratorDesign
    from lbt_synth.design.integrator_law import IntegratorLaw
    from lbt_synth.design.record import DesignRecord

_SIZES = {"gain", "phase_margin_deg", "modulus_margin"}  # what decides its gain


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


def _law(values: dict[str, Any]) -> IntegratorLaw:
    from lbt_synth.design.integrator_law import IntegratorLaw

    return IntegratorLaw(**values)


def _build(inputs: DesignInputs, options: IntegratorOptions) -> IntegratorDesign:
    from lbt_synth.design.integrator import integrator, optimal_integrator

    section: IntegratorOptions | None = inputs.method_section(METHOD.name)
    own = options.model_dump(exclude_unset=True)
    usual = {} if section is None else section.model_dump(exclude_unset=True)
    if own.keys() & _SIZES:
        usual = {name: value for name, value in usual.items() if name not in _SIZES}
    values = usual | own
    gain = values.pop("gain", None)
    law = _law(values)
    if gain is None:
        return optimal_integrator(inputs.hardware, inputs.truth, law=law)
    return integrator(inputs.hardware, gain=gain, law=law)


def _pack(design: IntegratorDesign) -> DesignRecord:
    from lbt_synth.design.record import DesignRecord

    return DesignRecord(
        meta={"integrator_gain": design.gain, "integrator_law": design.law.changes()}
    )


def _unpack(record: DesignRecord) -> IntegratorDesign:
    from lbt_synth.design.integrator import IntegratorDesign

    return IntegratorDesign(
        **record.common(),
        loop_hardware=record.hardware(),
        gain=number(record.meta["integrator_gain"], "integrator_gain", above=0),
        law=_law(record.meta["integrator_law"]),
    )


def _describe(design: IntegratorDesign) -> Description:
    return Description(facts=design.facts())


METHOD = Method(
    name="integrator",
    title="integrator",
    label="integrator",
    options=IntegratorOptions,
    section=IntegratorOptions,
    build=_build,
    pack=_pack,
    unpack=_unpack,
    describe=_describe,
    estimator=False,
    reference_rank=0,
)
