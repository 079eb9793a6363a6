"""The method of the classical integrator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from lbt_synth.methods.method import Description, DesignInputs, Method, Section
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import number

if TYPE_CHECKING:
    from lbt_synth.design.integrator import IntegratorDesign
    from lbt_synth.design.record import DesignRecord


class IntegratorOptions(Section):
    """Options of the integrator."""

    gain: float | None = Field(
        default=None, gt=0, description="its gain (default: the best for the truth)"
    )


@table_row
class IntegratorFacts:
    """The only number of an integrator."""

    gain: float = column("gain")


def _build(inputs: DesignInputs, options: IntegratorOptions) -> IntegratorDesign:
    from lbt_synth.design.integrator import integrator, optimal_integrator

    if options.gain is None:
        return optimal_integrator(inputs.hardware, inputs.truth)
    return integrator(inputs.hardware, gain=options.gain)


def _pack(design: IntegratorDesign) -> DesignRecord:
    from lbt_synth.design.record import DesignRecord

    return DesignRecord(meta={"integrator_gain": design.gain})


def _unpack(record: DesignRecord) -> IntegratorDesign:
    from lbt_synth.design.integrator import IntegratorDesign

    gain = number(record.meta["integrator_gain"], "integrator_gain", above=0)
    return IntegratorDesign(**record.common(), loop_hardware=record.hardware(), gain=gain)


def _describe(design: IntegratorDesign) -> Description:
    return Description(facts=IntegratorFacts(gain=design.gain))


METHOD = Method(
    name="integrator",
    title="integrator",
    label="integrator",
    options=IntegratorOptions,
    build=_build,
    pack=_pack,
    unpack=_unpack,
    describe=_describe,
    estimator=False,
    reference_rank=0,
)
