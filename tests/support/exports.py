"""Designs that the tests of the exports share, and the arithmetic of programs that load them."""

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
        return self.problem

    def examine(self):
        return Evidence(design=self, certificate=self.certificate)


def bare_design(controller):
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
    turned = copy.copy(design)
    set_fields(turned, controller=other)
    return turned


class DifferenceEquation:
    """``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``, each operation in the type of the rows."""

    def __init__(self, rows, limit=np.inf):
        self.rows, self.limit = np.asarray(rows), limit
        self.reset()

    def reset(self):
        self.past = np.zeros_like(self.rows)

    def step(self, y):
        order, past = len(self.rows) // 2, self.past
        past[: order + 1] = np.vstack([y, past[:order]])
        self.terms = self.rows * past
        u = np.clip(np.add.accumulate(self.terms)[-1], -self.limit, self.limit)
        past[order + 1 :] = np.vstack([u, past[order + 1 : -1]])
        return u.astype(float)


class CacaoProgram:
    """Frame by frame as modalfilter.c and applyPF.c do, with their ring and their indices."""

    def __init__(self, matrix, latency):
        self.matrix, self.latency = matrix.astype(np.float32), latency
        self.reset()

    def reset(self):
        modes, columns = self.matrix.shape
        self.ring, self.place = np.zeros((10, modes), np.float32), 0
        self.inputs = np.zeros(columns, np.float32)

    def step(self, y):
        frames, modes = int(self.latency), len(self.matrix)
        part = np.float32(self.latency - frames)
        # the command of this frame is written after it is known, where index 0 frames ago is
        now = (self.place + 1) % 10
        one, two = self.ring[(now - frames) % 10], self.ring[(now - frames - 1) % 10]
        late = (part * two).astype(float) + (1.0 - float(part)) * one.astype(float)
        self.inputs[modes:] = self.inputs[:-modes].copy()
        self.inputs[:modes] = y.astype(np.float32) - late.astype(np.float32)
        self.ring[self.place] = np.add.accumulate(self.inputs * self.matrix, axis=1)[:, -1]
        command, self.place = self.ring[self.place], now
        return -command.astype(float)
