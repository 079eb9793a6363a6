"""Designs that the tests of the exports share."""

import copy
from functools import cache

import numpy as np
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.design.certificate import Evidence
from lbt_synth.design.result import SolverReport
from lbt_synth.validation import set_fields


def relative(found, expected):
    return np.max(np.abs(np.asarray(found) - expected)) / np.max(np.abs(expected))


class BareDesign(lbt.Design):
    """A design whose problem is the controller itself, without a loop."""

    def make_controller(self):
        """Return it."""
        return self.problem

    def examine(self):
        """Compute nothing."""
        return Evidence(design=self, certificate=self.certificate)


def bare_design(controller):
    """A design of any controller, without a loop."""
    solver = SolverReport(route="riccati", status="made")
    return BareDesign(method="kalman", problem=controller, solver=solver)


@cache
def lbt_config():
    return lbt.load_config(LBT_YAML)


@cache
def lbt_designs():
    config = lbt_config()

    spread = lbt.models.spread_plant(config.plant, half_width_hz=3.5, lines=3)
    return {
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2),
        "integrator": lbt.integrator(config.hardware, truth=config.truth),
        "turned": turn_states(lbt.kalman(spread)),
    }


def turn_states(design):
    """The same controller in other coordinates, without a zero: loops over whole matrices."""
    own = design.controller
    T, _ = np.linalg.qr(np.random.default_rng(8).standard_normal(own.A.shape))
    other = lbt.Controller(A=T @ own.A @ T.T, B=T @ own.B, C=own.C @ T.T, D=own.D, dt_s=own.dt_s)
    return with_controller(design, other)


def with_controller(design, controller):
    """A design with a controller that is not its own, for what runs any controller."""
    other = copy.copy(design)
    set_fields(other, controller=controller)
    return other
