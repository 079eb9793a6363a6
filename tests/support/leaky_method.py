"""A method of synthesis that the package does not have, whole in one file: a leaky integrator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field

from lbt_synth.design import Design, SolverReport, certify_loop
from lbt_synth.design.record import DesignRecord
from lbt_synth.design.result import UNCERTIFIED, with_certificate
from lbt_synth.linear import Controller
from lbt_synth.methods import Description, Method, RowTable, Section
from lbt_synth.models import LoopHardware
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import set_fields


class LeakyOptions(Section):
    """Options of the leaky integrator."""

    gain: float = Field(default=0.3, gt=0, description="its gain")
    leak_per_s: float = Field(gt=0, description="part of the command lost [1/s]", examples=[5])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeakyDesign(Design):
    """An integrator that forgets."""

    controller: Controller = field(init=False)
    loop_hardware: LoopHardware
    gain: float
    leak_per_s: float

    def __post_init__(self):
        hardware = self.loop_hardware
        back = np.linalg.pinv(hardware.sensor @ hardware.influence)
        each = np.eye(hardware.modes)
        controller = Controller(
            A=np.exp(-self.leak_per_s * hardware.dt_s) * each,
            B=self.gain * back,
            C=each,
            D=np.zeros((hardware.modes, back.shape[1])),
            dt_s=hardware.dt_s,
        )
        set_fields(self, controller=controller)

    @property
    def hardware(self):
        """The loop."""
        return self.loop_hardware

    def recertify(self):
        """Check the loop again."""
        return replace(UNCERTIFIED, checks=(certify_loop(self.loop_hardware, self.controller),))


@table_row
class LeakyFacts:
    """What it is."""

    gain: float = column("gain")
    leak_per_s: float = column("leak", unit="1/s")


@table_row
class LeakRow:
    """What is left."""

    after_s: float = column("after", unit="s")
    left: float = column("left", unit="%", scale=100, format=".1f")


def build(inputs, options):
    """Design it."""
    design = LeakyDesign(
        method="leaky",
        certificate=UNCERTIFIED,
        solver=SolverReport(route="closed form", status="given", iterations=0),
        loop_hardware=inputs.hardware,
        gain=options.gain,
        leak_per_s=options.leak_per_s,
    )
    return with_certificate(design, "Lower the gain.")


def unpack(record):
    """Read it from a gain file."""
    return LeakyDesign(**record.common(), loop_hardware=record.hardware(), **record.meta["leaky"])


def describe(design):
    """Say what it is."""
    rows = [LeakRow(after_s=t, left=float(np.exp(-design.leak_per_s * t))) for t in (0.01, 0.1)]
    return Description(
        facts=LeakyFacts(gain=design.gain, leak_per_s=design.leak_per_s),
        tables=[RowTable(key="leak", title="What is left", rows=rows)],
        notes=["note: this integrator forgets."],
        matrices={"forgets": design.controller.A},
    )


METHOD = Method(
    name="leaky",
    title="leaky integrator",
    label="leaky",
    options=LeakyOptions,
    build=build,
    pack=lambda d: DesignRecord(meta={"leaky": {"gain": d.gain, "leak_per_s": d.leak_per_s}}),
    unpack=unpack,
    describe=describe,
    estimator=False,
    configurable=frozenset({"gain"}),
)
