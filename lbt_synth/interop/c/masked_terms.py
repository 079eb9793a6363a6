"""The arithmetic of exported C source of several sensors: its coefficients, a run, and a proof.

The estimator form of a periodic filter: in each frame it predicts from the commands that were
applied, and corrects by what each new reading differs from its prediction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Check, Design, FilterDesign
from lbt_synth.interop.c.source_text import round_to_single
from lbt_synth.interop.export_checks import FRAMES
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import close_loop
from lbt_synth.loop.budget import plant_budget
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.simulation.failing_sensors import Drop, simulate_sensors
from lbt_synth.models import TipTiltPlant, Truth
from lbt_synth.validation import BoolArray, FloatArray

_LOSS = 0.01  # of the residual, relative


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskedTerms:
    """The coefficients of a filter of several sensors, as its source has them.

    With the states x (s,), of which the first n are estimates, and the commands u(k-1) that were
    applied, the source computes ``x+ = transition [x, u] + gains (y + innovation [x, u])`` in a
    frame, and ``u(k) = command x+``.
    """

    transition: FloatArray  # (N, s, s + m)
    innovation: FloatArray  # (N, q, s + m): minus what a reading is predicted to be
    command: FloatArray  # (m, s)
    gains: Mapping[frozenset[str], FloatArray]  # (N, n, q) for each set that is missing
    read: BoolArray  # (N, q): which readings are due
    rows: Mapping[str, slice]  # of each sensor or channel in y
    dt_s: float

    def rounded(self) -> MaskedTerms:
        """Return the terms in single precision."""
        names = ("transition", "innovation", "command")
        whole = round_to_single({name: getattr(self, name) for name in names})
        return replace(
            self,
            transition=whole["transition"],
            innovation=whole["innovation"],
            command=whole["command"],
            gains={some: round_to_single({"gains": K})["gains"] for some, K in self.gains.items()},
        )

    def controller(self, missing: frozenset[str] = frozenset()) -> Controller:
        """Return the controller that the terms make where its own commands are applied."""
        K = np.zeros((*self.transition.shape[:2], self.read.shape[1]))
        K[:, : self.gains[missing].shape[1]] = self.gains[missing]
        whole = self.transition + K @ self.innovation
        A, applied = np.split(whole, [whole.shape[1]], axis=2)
        return Controller(
            A=A + applied @ self.command,
            B=K,
            C=self.command,
            D=np.zeros((len(self.command), K.shape[2])),
            dt_s=self.dt_s,
        )


def masked_terms(design: FilterDesign) -> MaskedTerms:
    """Return the coefficients of a filter of several sensors and of its fall-backs."""
    plant = cast("TipTiltPlant", design.problem)
    full = plant.full()
    n, s, m = plant.n_states, full.n_states, plant.hardware.n_commands
    A, _, C, _ = full.stacks()
    transition = np.zeros((plant.period, s, s + m))
    transition[:, :, :s], transition[:, :, s:] = A, full.B_known
    predicted = np.zeros((plant.period, plant.n_measurements, s + m))
    predicted[:, :, :s], predicted[:, :, s:] = C, full.D_known
    filters = {(): design.gain_predictor} | {f.missing: f.gains for f in design.fallbacks}
    return MaskedTerms(
        transition=transition,
        innovation=-predicted,
        command=design.controller.stacks()[2][0],
        gains={
            frozenset(missing): np.reshape(gains, (plant.period, n, plant.n_measurements))
            for missing, gains in filters.items()
        },
        read=plant.read,
        rows=plant.hardware.suite.rows(plant.hardware),
        dt_s=plant.dt_s,
    )


class MaskedSource:
    """A source of several sensors, stepped as it is written: term by term, each rounded."""

    def __init__(self, terms: MaskedTerms, dtype: Any) -> None:
        self._terms, self._dtype = terms, dtype
        self._parts = [terms.transition, terms.innovation, terms.command]
        self._parts = [part.astype(dtype) for part in self._parts]
        self._gains = {some: gains.astype(dtype) for some, gains in terms.gains.items()}
        self.reset()

    def reset(self) -> None:
        """Set states and last commands to zero; the next frame is the first of a period."""
        self._state = np.zeros(self._parts[2].shape[1], dtype=self._dtype)
        self._last = np.zeros(len(self._parts[2]), dtype=self._dtype)
        self._phase, self._missing = 0, frozenset[str]()

    def step(
        self,
        y: FloatArray,
        fresh: Mapping[str, bool] | None = None,
        applied: ArrayLike | None = None,
    ) -> FloatArray:
        """Take y(k), what is new and the commands u(k-1) that were applied; return u(k).

        By default all that is due is new, and its own commands were applied.
        """
        rows, read = self._terms.rows, self._terms.read[self._phase]
        due = frozenset(unit for unit, own in rows.items() if read[own.start])
        new = frozenset(
            unit
            for unit in due
            if (fresh is None or fresh[unit]) and np.all(np.isfinite(y[rows[unit]]))
        )
        self._missing = (self._missing - due) | (due - new)
        transition, innovation = (part[self._phase] for part in self._parts[:2])
        gains, command = self._gains[self._missing][self._phase], self._parts[2]
        given = self._last if applied is None else np.asarray(applied, dtype=self._dtype)
        signals = np.concatenate([self._state, given])
        measured = np.asarray(y, dtype=self._dtype)[:, None]
        errors = np.add.accumulate(np.hstack([measured, innovation * signals]), axis=1)[:, -1]
        self._state = np.add.accumulate(transition * signals, axis=1)[:, -1]
        for unit in (unit for unit in rows if unit in new):
            for row in range(rows[unit].start, rows[unit].stop):
                self._state[: len(gains)] += gains[:, row] * errors[row]
        self._last = np.add.accumulate(command * self._state, axis=1)[:, -1]
        self._phase = (self._phase + 1) % len(self._terms.read)
        return np.asarray(self._last, dtype=np.float64)


def masked_rehearsal_error(design: Design, terms: MaskedTerms, dtype: Any) -> float:
    """Largest difference of commands from the design's, over the largest command.

    Both get the readings and commands of a run of the design's loop, in which each sensor and
    channel is missing for a while. The source is stable by itself, so that no loop is needed.
    """
    plant, units = design.problem, tuple(terms.rows)
    rate = plant.hardware.frame_rate_hz
    turns = 2 * len(units) + 1
    length = plant.period * int(np.ceil(FRAMES / turns / plant.period))  # all are due at its begin
    starts = {unit: (2 * i + 1) * length for i, unit in enumerate(units)}
    run = simulate_sensors(
        design.controllers,
        Truth(
            turbulence=plant.turbulence,
            vibrations=plant.vibrations,
            motions=plant.motions,
            noise_nm=np.linalg.norm(plant.own_noise_factor, axis=1),
        ),
        hardware=plant.hardware,
        frames=turns * length,
        settle_frames=0,
        drops=[
            Drop(unit=unit, start_s=start / rate, end_s=(start + length) / rate)
            for unit, start in starts.items()
        ],
    )
    expected, readings = run.commands[0], run.measurements[0]
    source = MaskedSource(terms, dtype)
    found, last = np.empty_like(expected), np.zeros_like(expected[0])
    with np.errstate(all="ignore"):  # what overflows is found to be infinite
        for k, y in enumerate(readings):
            fresh = {unit: not 0 <= k - start < length for unit, start in starts.items()}
            found[k] = source.step(y, fresh, last)
            last = expected[k]
        error = float(np.max(np.abs(found - expected)) / np.max(np.abs(expected)))
    return error if np.isfinite(error) else float("inf")


def prove_masked(design: Design, terms: MaskedTerms) -> tuple[Check, ...]:
    """Check the loops around the coefficients of a source: that of all sensors, and the others.

    The estimator is stable by itself, with all sensors; each loop is stable, with the residual of
    the design's where the plant is its model. Of loops with sensors missing the worst counts.
    """
    n, how = terms.transition.shape[1], "eigenvalues of the monodromy, per frame"
    alone = (terms.transition + terms.controller().B @ terms.innovation)[:, :, :n]
    still = StateSpace(A=alone, B=np.zeros((n, 0)), C=np.zeros((0, n)), D=np.zeros((0, 0)))
    limit = 1 - STABILITY_MARGIN
    name = "spectral radius of the estimator alone"
    checks = [Check(name, still.radius_per_frame, limit, how)]
    plant, controllers = design.problem, design.controllers
    for name, sets in (
        ("all sensors", [frozenset[str]()]),
        ("any sensors missing", [some for some in terms.gains if some]),
    ):
        radii, losses = [0.0], [0.0]
        for some in sets:
            loops = [
                close_loop(plant.hardware, k, blind=tuple(some))
                for k in (terms.controller(some), controllers[some])
            ]
            radii.append(loops[0].system.radius_per_frame)
            if not loops[0].is_stable:
                losses.append(np.inf)
                break
            own, before = (plant_budget(loop, plant).rms_nm for loop in loops)
            losses.append(own / before - 1)
        checks.append(Check(f"spectral radius with {name}", max(radii), limit, how))
        what = f"residual with {name}, loss"
        checks.append(Check(what, max(losses), _LOSS, "Lyapunov equations"))
    return tuple(checks)
