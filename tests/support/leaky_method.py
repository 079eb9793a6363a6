"""A method of synthesis that the package does not have, whole in one file: a leaky integrator."""

import numpy as np
from pydantic import Field

from lbt_synth.design import Design, SolverReport
from lbt_synth.design.certificate import Check
from lbt_synth.design.claims import Claim, Evidence
from lbt_synth.design.result import UNCERTIFIED, RowTable, with_certificate
from lbt_synth.linear import Controller
from lbt_synth.methods import Method, Section
from lbt_synth.storage.rows import Column, Facts


class LeakyOptions(Section):
    """Options of the leaky integrator."""

    gain: float = Field(default=0.3, gt=0, description="its gain")
    leak_per_s: float = Field(gt=0, description="part of the command lost [1/s]", examples=[5])


def check_leak(evidence, leak_per_s):
    """Check that the controller forgets as fast as it claims."""
    design = evidence.design
    apart = design.controller.A[0, 0] / np.exp(-leak_per_s * design.problem.dt_s) - 1
    yield Check("leak, against the one claimed", abs(apart), 1e-9, "eigenvalue")


class LeakyDesign(Design):
    """An integrator that forgets."""

    CLAIMS = (
        Claim(name="gain", heading="gain"),
        Claim(name="leak_per_s", heading="leak", unit="1/s", checks=check_leak),
    )

    def make_controller(self):
        """Return the controller of the claims."""
        path, claims = self.problem, self.claims
        back, each = np.linalg.pinv(path.sensor @ path.influence), np.eye(path.modes)
        A, D = np.exp(-claims["leak_per_s"] * path.dt_s) * each, np.zeros_like(back)
        return Controller(A=A, B=claims["gain"] * back, C=each, D=D, dt_s=path.dt_s)

    def examine(self):
        """Compute nothing but the loop."""
        return Evidence(design=self, certificate=UNCERTIFIED)

    def tables(self):
        """Return what is left of a command."""
        after, left = Column(name="after_s", heading="after"), Column(name="left", heading="left")
        decay = -self.claims["leak_per_s"]
        rows = [
            Facts((after, left), {"after_s": t, "left": np.exp(decay * t)}) for t in (0.01, 0.1)
        ]
        return (RowTable(key="leak", title="What is left", rows=rows),)

    def notes(self):
        """Return a warning."""
        return ["note: this integrator forgets."]


def build(inputs, options):
    """Design it."""
    solver = SolverReport(route="closed form", status="given", iterations=0)
    claims = options.model_dump()
    design = LeakyDesign(method="leaky", problem=inputs.hardware, claims=claims, solver=solver)
    return with_certificate(design, "Lower the gain.")


METHOD = Method(
    name="leaky",
    title="leaky integrator",
    label="leaky",
    options=LeakyOptions,
    build=build,
    design="lbt_synth.methods.leaky:LeakyDesign",
    estimator=False,
    configurable=frozenset({"gain"}),
)
