"""A least-squares predictor as a design: a stable filter of readings, made from a record.

The filter reads the pseudo-open-loop measurement and, where the loop has them, accelerometers. The
loop is a pure delay with a known command, so every stable filter of these makes a stable loop at
the assumed sensor gain (:func:`youla_controller`). What it leaves is what its record shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import block_diag, svd

from lbt_synth.design.certificate import TOLERANCE, Check, Claim, Evidence, stability_check
from lbt_synth.design.result import (
    SENSOR_FACTS,
    UNCERTIFIED,
    Design,
    RowTable,
    SolverReport,
    sensor_facts,
    with_certificate,
)
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.lyapunov import output_variances, stationary_root
from lbt_synth.loop import close_loop
from lbt_synth.loop.closed_loop import youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.storage.rows import Column, fact, facts
from lbt_synth.validation import FloatArray, frozen_copy

_ORDERS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # of reduced filters, by about a third
_LOST = 5e-3  # of the variance that the long filter leaves, which a reduced one may add
_DRIVEN = 20_000  # frames of a record over which states are compared
_STABLE = 1 - 1e-7  # spectral radius of a filter: one that forgets within a day at 1 kHz


def _check_noise(evidence: Evidence, claimed: tuple[float, ...]) -> Iterator[Check]:
    """Compare the commands that white readings make with those that are claimed."""
    apart = np.abs(np.array(command_rms(evidence.design.parameters)) / np.array(claimed) - 1)
    how = "adjoint Lyapunov equation"
    yield Check("command of white readings, against the one claimed", apart.max(), TOLERANCE, how)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorDesign(Design):
    """A controller that predicts the disturbance by a filter of least squares.

    It claims what it leaves on frames of its record that it was not fitted to, as does its
    fall-back without the other sensors [nm rms], by which share the fit itself adds to that, and
    the command that a reading of unit white noise makes, for each reading of both filters.
    """

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        Claim(name="residual_nm", heading="residual on unseen frames of its record", unit="nm"),
        Claim(name="residual_error_nm", heading="standard error of that", unit="nm"),
        Claim(name="fit_share", heading="of their variance, which the fit of all frames adds"),
        Claim(name="alone_nm", heading="residual of the fall-back on these frames", unit="nm"),
        Claim(name="command_rms", checks=_check_noise),
    )
    DERIVED: ClassVar[tuple[Column, ...]] = SENSOR_FACTS

    problem: LoopHardware  # with the sensors that are read
    # the filter from the pseudo-open-loop measurement and the readings of all other sensors to
    # the command; where there are others, one without them as a fall-back
    parameters: tuple[Controller, ...]

    def make_controller(self) -> Controller:
        """Return the controller of the first filter, with the states of both."""
        return self._controller(0)

    def _controller(self, chosen: int) -> Controller:
        """Return the controller of one filter; all of them have the same states."""
        readings, read = self.problem.n_readings, self.parameters[chosen].B.shape[1]
        inputs = [p.B[:, :read] for p in self.parameters]  # zero for what a filter does not take
        inputs = [np.pad(B, ((0, 0), (0, readings - B.shape[1]))) for B in inputs]
        parts = [(p.A, B, p.C) for p, B in zip(self.parameters, inputs, strict=True)]
        A, B = block_diag(*(A for A, *_ in parts)), np.vstack([B for _, B, _ in parts])
        outputs = [C if i == chosen else 0 * C for i, (*_, C) in enumerate(parts)]
        C, D = np.hstack(outputs), np.zeros((len(outputs[0]), readings))
        joint = Controller(A=A, B=B, C=C, D=D, dt_s=self.problem.dt_s)
        return youla_controller(self.problem, joint, stored=len(parts) > 1)

    @property
    def controllers(self) -> dict[frozenset[str], Controller]:
        """The controller of all sensors, and that of the loop's own alone."""
        controllers = {frozenset[str](): self.controller}
        if len(self.parameters) > 1:
            controllers[frozenset(self.problem.suite.units[1:])] = self._controller(1)
        return controllers

    @property
    def expected_residual_nm(self) -> float | None:
        """Residual on frames of the record that the design was not fitted to [nm rms]."""
        return self.claims.get("residual_nm")

    def derived(self) -> dict[str, Any]:
        """Return the sensors, and where the loop is stable."""
        return dict(sensor_facts(self, self.problem))

    def tables(self) -> tuple[RowTable, ...]:
        """Return what noise of each reading becomes."""
        suite, q = self.problem.suite, self.problem.n_measurements
        names = [*(f"wavefront {i + 1}" for i in range(q)), *suite.channels]
        units = ["nm"] * q + ["m/s^2"] * len(suite.channels)
        rows = [
            facts(
                reading=fact(name, "reading"),
                unit=fact(unit, "unit of the noise"),
                command_rms=fact(gain, "command over it, rms", format=".4g"),
            )
            for name, unit, gain in zip(names, units, self.claims["command_rms"], strict=False)
        ]
        return (RowTable(key="noise", title="Command of white noise of a reading", rows=rows),)

    def notes(self) -> list[str]:
        """Return what the claims rest on."""
        notes = ["note: a record is no model: the residual is that of its second half."]
        if self.other_sensors:
            notes.append(
                "note: a channel that fails moves no pole of the loop. If it is seen, the loop "
                "goes on with the fall-back, which reads the wavefront alone."
            )
        return notes

    def examine(self) -> Evidence:
        """Compute whether the filters are stable, and the loops of both."""
        checks = []
        names = ("spectral radius of the filter", "spectral radius of the fall-back's filter")
        for name, parameter in zip(names, self.parameters, strict=False):
            radius = parameter.to_statespace().spectral_radius
            checks.append(Check(name, radius, _STABLE, "eigenvalues"))
        for missing, controller in self.controllers.items():
            if missing and all(check.passed for check in checks):
                loop = close_loop(self.problem, controller)
                checks.append(stability_check("spectral radius of the fall-back's loop", loop))
        return Evidence(design=self, certificate=replace(UNCERTIFIED, checks=tuple(checks)))


def command_rms(parameters: Sequence[Controller]) -> tuple[float, ...]:
    """Return the rms command that each reading makes if it is unit white noise, filter by filter.

    By the adjoint equation: the squared norm of input i is ``B' W B`` of the observability Gramian.
    """
    norms = [
        np.sqrt(output_variances(p.B.T, p.D.T, stationary_root(p.A.T, p.C.T))) for p in parameters
    ]
    return tuple(np.concatenate(norms).tolist())


def regression_filter(
    hardware: LoopHardware, base: Controller, coefficients: FloatArray
) -> Controller:
    """Return the filter of a base, whose loop is stable, and of what a regression adds to it.

    The coefficients (taps, n, 2 n + c) are added to the correction of each mode, per value of the
    base's correction, of the pseudo-open-loop measurement and of the channels; the newest first.
    """
    taps, n, signals = coefficients.shape
    own = youla_controller(hardware, base, sign=-1.0)
    back, out = np.linalg.pinv(hardware.sensor), hardware.projector
    q, c = hardware.n_measurements, signals - 2 * n
    into = coefficients.reshape(taps * n, signals)
    from_base = into[:, :n] @ hardware.influence @ own.C  # by its new state
    B = np.block(
        [
            [own.B, np.zeros((own.n_states, c))],
            [from_base @ own.B + into[:, n : 2 * n] @ back, into[:, 2 * n :]],
        ]
    )
    A = block_diag(own.A, np.eye(taps * n, k=n))
    A[own.n_states :, : own.n_states] = from_base @ own.A
    C = np.hstack([own.C, out, np.zeros((len(out), (taps - 1) * n))])
    return Controller(A=A, B=B, C=C, D=np.zeros((len(C), q + c)), dt_s=hardware.dt_s)


def reduce_filter(
    parameter: Controller, readings: FloatArray, residual_nm2: float
) -> tuple[Controller, float]:
    """Return a filter of few states, and the rms by which its command differs on a record.

    A balanced truncation whose inputs are the readings (frames, q) of the record: the states that
    are kept move the command most while these are read (D. F. Enns, Proc. 23rd IEEE Conf. Decision
    and Control, 127 (1984), doi:10.1109/CDC.1984.272286). The fewest states are taken that add less
    than 0.5 % to a residual variance.
    """
    n, last = parameter.n_states, readings[-_DRIVEN:]
    states = StateSpace(
        A=parameter.A,
        B=parameter.B,
        C=parameter.A,  # in the new-state form
        D=parameter.B,
        dt_s=parameter.dt_s,
    )
    driven = filter_series(states, last)[len(last) // 10 :]
    reached = svd(driven / np.sqrt(len(driven)), full_matrices=False)
    root = reached[2].T * reached[1]  # P = root root'
    seen = stationary_root(parameter.A.T, parameter.C.T)  # W = seen seen'
    U, sizes, V = svd(seen.T @ root, full_matrices=False)
    whole = driven @ parameter.C.T
    for order in (order for order in _ORDERS if order < min(n, len(sizes))):
        scale = 1 / np.sqrt(sizes[:order])
        into, back = (seen @ U[:, :order] * scale).T, root @ V[:order].T * scale
        few = Controller(
            A=frozen_copy(into @ parameter.A @ back),
            B=frozen_copy(into @ parameter.B),
            C=frozen_copy(parameter.C @ back),
            D=parameter.D,
            dt_s=parameter.dt_s,
        )
        system = few.to_statespace()
        if not system.spectral_radius < _STABLE:
            continue
        apart = filter_series(system, last)[len(last) // 10 :] - whole
        lost_nm2 = float(np.sum(np.mean(apart**2, axis=0)))
        if lost_nm2 < _LOST * residual_nm2:
            return few, float(np.sqrt(lost_nm2))
    return parameter, 0.0


def _reduce_groups(
    parameter: Controller,
    readings: FloatArray,
    residual_nm2: float,
    groups: Sequence[Sequence[int]],
) -> tuple[Controller, float]:
    """Reduce the filter of each group of axes, which reads no measurement of the others."""
    axes, filters, lost_nm = range(parameter.C.shape[0]), list[Controller](), list[float]()
    for group in groups:
        B = parameter.B.copy()
        B[:, [axis for axis in axes if axis not in group]] = 0.0
        C, D = parameter.C[list(group)], parameter.D[list(group)]
        few, lost = reduce_filter(
            replace(parameter, B=B, C=C, D=D), readings, residual_nm2 / len(groups)
        )
        filters.append(few)
        lost_nm.append(lost)
    joint = replace(
        parameter,
        A=block_diag(*(few.A for few in filters)),
        B=np.vstack([few.B for few in filters]),
        C=block_diag(*(few.C for few in filters)),
    )
    return joint, float(np.linalg.norm(lost_nm))


def predictor_design(
    hardware: LoopHardware,
    filters: Sequence[Controller],
    readings: FloatArray,
    residual_nm2: float,
    *,
    groups: Sequence[Sequence[int]],
    what: str,
    **claims: float,
) -> PredictorDesign:
    """Reduce the filters of a record, for each group of axes, and certify the design of them."""
    if len(filters) != 1 + bool(hardware.suite.sensors):
        raise ProblemError("a predictor needs one filter, and a fall-back for other sensors.")
    pairs = [_reduce_groups(p, readings[:, : p.B.shape[1]], residual_nm2, groups) for p in filters]
    short, lost = zip(*pairs, strict=True)
    status = f"{what}; reduced by {lost[0]:.2g} nm"
    design = PredictorDesign(
        method="predictor",
        problem=hardware,
        parameters=short,
        claims={**claims, "command_rms": command_rms(short)},
        solver=SolverReport(route="least squares", status=status),
    )
    return with_certificate(design, "Try a longer record, or the method kalman.")
