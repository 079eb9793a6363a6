"""A method of synthesis that the package does not have, whole in one file: a leaky integrator."""

import numpy as np
from pydantic import Field

from lbt_synth.design import Check, Design
from lbt_synth.design.certificate import Claim
from lbt_synth.design.result import SolverReport, with_certificate
from lbt_synth.linear import Controller
from lbt_synth.methods.method import Method, Section


class LeakyOptions(Section):
    """Options of the leaky integrator."""

    gain: float = Field(default=0.3, gt=0, description="its gain")
    leak_per_s: float = Field(gt=0, description="part of the command lost [1/s]", examples=[5])


def check_leak(evidence, leak_per_s):
    """Check that the controller forgets as fast as it claims."""
    k = evidence.design.controller
    apart = k.A[0, 0] / np.exp(-leak_per_s * k.dt_s) - 1
    yield Check("leak, against the one claimed", abs(apart), 1e-9, "eigenvalue")


class LeakyDesign(Design):
    """An integrator that forgets."""

    CLAIMS = (
        Claim(name="gain", heading="gain"),
        Claim(name="leak_per_s", heading="leak", unit="1/s", checks=check_leak),
    )

    def make_controller(self):
        """Return the controller of the claims."""
        path, each = self.problem, np.eye(self.problem.modes)
        back = self.claims["gain"] * np.linalg.pinv(path.sensor @ path.influence)
        A = np.exp(-self.claims["leak_per_s"] * path.dt_s) * each
        return Controller(A=A, B=back, C=each, D=0 * back, dt_s=path.dt_s)


def build(inputs, options):
    """Design it."""
    claims = {"problem": inputs.plant.hardware, "claims": options.model_dump()}
    solver = SolverReport(route="closed form", status="given")
    return with_certificate(LeakyDesign(method="leaky", solver=solver, **claims), "Lower the gain.")


METHOD = Method(
    name="leaky",
    title="leaky integrator",
    label="leaky",
    options=LeakyOptions,
    build=build,
    design="support.leaky_method:LeakyDesign",
    estimator=False,
    configurable=frozenset({"gain"}),
)
