"""The method of the classical integrator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from lbt_synth.methods.method import DesignInputs, Method, Section

if TYPE_CHECKING:
    from lbt_synth.design.integrator import IntegratorDesign

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


def _build(inputs: DesignInputs, options: IntegratorOptions) -> IntegratorDesign:
    from lbt_synth.design.integrator import IntegratorLaw, integrator, optimal_integrator

    section: IntegratorOptions | None = inputs.method_section(METHOD.name)
    own = options.model_dump(exclude_unset=True)
    usual = {} if section is None else section.model_dump(exclude_unset=True)
    if own.keys() & _SIZES:
        usual = {name: value for name, value in usual.items() if name not in _SIZES}
    values = usual | own
    gain = values.pop("gain", None)
    law = IntegratorLaw(**values)
    if gain is None:
        return optimal_integrator(inputs.hardware, inputs.truth, law=law)
    return integrator(inputs.hardware, gain=gain, law=law)


METHOD = Method(
    name="integrator",
    title="integrator",
    label="integrator",
    options=IntegratorOptions,
    section=IntegratorOptions,
    build=_build,
    design="lbt_synth.design.integrator:IntegratorDesign",
    estimator=False,
    reference_rank=0,
    compared_options={"phase_margin_deg": 45.0},  # one that a telescope would run
)
