"""The terms of exported C source: made of a design, stepped, proved, read from its text.

A frame predicts from the state and the commands that were applied, and corrects by what is new. A
controller of one sensor is the case of one phase in which every reading is new and predicted as 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.design import Check, Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.interop.pipeline import ModeDesign
from lbt_synth.interop.proof import EIGENVALUES, ROUNDOFF, Written, sums_variance
from lbt_synth.linear import Controller, StateSpace, estimator_form
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.validation import BoolArray, FloatArray

_CONSTANT = ("transition", "innovation", "command")  # matrices that no missing sensor changes
NONE = frozenset[str]()  # no sensor is missing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceTerms:
    """The coefficients of a source.

    With the states x (s,), of which the first n are corrected, and the commands a (m,) that were
    applied in the last frame, a frame computes ``e = y + innovation [x, a]``,
    ``x+ = transition [x, a] + gains e`` of the readings that are new, and ``u = command [x+, y]``.
    """

    transition: FloatArray  # (N, s, s + m)
    innovation: FloatArray  # (N, q, s + m): minus what a reading is predicted to be
    gains: Mapping[frozenset[str], FloatArray]  # (N, n, q) for each set that is missing
    command: FloatArray  # (m, s + q)
    read: BoolArray  # (N, q): which readings are due
    rows: Mapping[str, slice]  # of each sensor or channel in y
    dt_s: float
    applied: bool  # whether the source is given the commands that were applied
    switched: bool = False  # of two "phases": all is read, or the loop's own sensor alone
    single: bool = False  # whether its numbers are of single precision

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of states, of readings and of commands."""
        m, columns = self.command.shape
        q = self.read.shape[1]
        return columns - q, q, m

    @property
    def masked(self) -> bool:
        """Whether it is told which readings are new."""
        return len(self.rows) > 1

    @property
    def tabled(self) -> bool:
        """Whether the gains of each set that is missing stand in a table."""
        return self.masked and not self.switched

    @property
    def whole(self) -> FloatArray:
        """All matrices of one sensor: columns of states, applied commands and measurements."""
        (s, _, m), gains = self.sizes, self.gains[NONE][0]
        states, through = np.hsplit(self.command, [s])
        return np.block([[self.transition[0], gains], [states, np.zeros((m, m)), through]])

    def rounded(self) -> SourceTerms:
        """Return the terms in single precision; refuse numbers that do not fit."""
        matrices: dict[str, Any] = {name: _to_single(getattr(self, name)) for name in _CONSTANT}
        gains = {some: _to_single(K) for some, K in self.gains.items()}
        return replace(self, **matrices, gains=gains, single=True)

    def phase(self, k: int) -> SourceTerms:
        """Return the terms of one phase alone, as those of one sensor."""
        one = slice(k, k + 1)
        matrices: dict[str, Any] = {
            name: getattr(self, name)[one] for name in ("transition", "innovation", "read")
        }
        rows = {"measurements": slice(0, self.read.shape[1])}
        gains = {NONE: self.gains[NONE][one]}
        return replace(self, **matrices, gains=gains, rows=rows, switched=False)

    def controller(self, missing: frozenset[str] = NONE) -> Controller:
        """Return the controller that the terms make where its own commands are applied."""
        (s, *_), K = self.sizes, np.zeros((*self.transition.shape[:2], self.read.shape[1]))
        K[:, : self.gains[missing].shape[1]] = self.gains[missing]
        corrected = self.transition + K @ self.innovation
        states, through = np.hsplit(self.command, [s])
        return Controller(
            A=corrected[:, :, :s] + corrected[:, :, s:] @ states,
            B=K,
            C=states,
            D=through,
            dt_s=self.dt_s,
        )


def _to_single(values: FloatArray) -> FloatArray:
    most, largest = float(np.finfo(np.float32).max), float(np.max(np.abs(values), initial=0.0))
    if largest > most:
        raise ProblemError(
            f"the coefficients must be below {most:.3g} in single precision; got {largest:.3g}. "
            "Try double precision, or scale the states."
        )
    return values.astype(np.float32).astype(np.float64)


def source_terms(design: Design, *, form: str = "plain") -> SourceTerms:
    """Return the coefficients of a design, or of a filter of several sensors and its fall-backs."""
    if design.other_sensors and design.plant is not None:
        return _filter_terms(design)
    if form == "plain" and not design.other_sensors:
        return controller_terms(design.controller)
    hardware = require_hardware(design, "the estimator form")  # a bare filter moves no mirror
    phases = [_estimator_terms(controller) for controller in design.controllers.values()]
    if len(phases) == 1:
        return phases[0]
    stacks: dict[str, Any] = {
        name: np.concatenate([getattr(terms, name) for terms in phases])
        for name in ("transition", "innovation", "read")
    }
    return replace(
        phases[0],
        **stacks,
        gains={NONE: np.concatenate([terms.gains[NONE] for terms in phases])},
        rows=hardware.suite.rows(hardware),
        switched=True,
    )


def _estimator_terms(controller: Controller) -> SourceTerms:
    """Return the coefficients of the estimator form of a controller."""
    estimator = estimator_form(controller)
    inputs = np.hstack([estimator.B, estimator.applied])
    D = np.zeros((len(estimator.C), inputs.shape[1]))
    joint = Controller(A=estimator.A, B=inputs, C=estimator.C, D=D, dt_s=estimator.dt_s)
    return controller_terms(joint, len(estimator.C))


def controller_terms(controller: Controller, applied: int = 0) -> SourceTerms:
    """Return the coefficients of a controller, whose last inputs are the applied commands."""
    m, q = controller.D.shape[0], controller.D.shape[1] - applied
    B, L = np.hsplit(controller.B, [q])
    L = L if applied else np.zeros((len(B), m))
    return SourceTerms(
        transition=np.hstack([controller.A, L])[None],
        innovation=np.zeros((1, q, len(B) + m)),
        gains={NONE: B[None]},
        command=np.hstack([controller.C, controller.D[:, :q]]),
        read=np.ones((1, q), dtype=np.bool_),
        rows={"measurements": slice(0, q)},
        dt_s=controller.dt_s,
        applied=applied > 0,
    )


def _filter_terms(design: Any) -> SourceTerms:
    """Return the coefficients of a filter of several sensors and of its fall-backs."""
    plant = design.problem
    full = plant.full()
    n, s, m = plant.n_states, full.n_states, plant.hardware.n_commands
    transition = np.zeros((plant.period, s, s + m))
    transition[:, :, :s], transition[:, :, s:] = full.A, full.B_known
    predicted = np.zeros((plant.period, plant.n_measurements, s + m))
    predicted[:, :, :s], predicted[:, :, s:] = full.C, full.D_known
    filters = {(): design.gain_predictor, **design.fallbacks}
    states = design.controller.stacks()[2][0]
    return SourceTerms(
        transition=transition,
        innovation=-predicted,
        gains={
            frozenset(missing): np.reshape(gains, (plant.period, n, plant.n_measurements))
            for missing, gains in filters.items()
        },
        command=np.hstack([states, np.zeros((m, plant.n_measurements))]),
        read=plant.read,
        rows=plant.hardware.suite.rows(plant.hardware),
        dt_s=plant.dt_s,
        applied=True,
    )


class RunningSource:
    """A source, stepped as it is written: term by term from left to right, each rounded."""

    def __init__(self, terms: SourceTerms) -> None:
        self._terms, self._dtype = terms, np.float32 if terms.single else np.float64
        self._matrices = [getattr(terms, name).astype(self._dtype) for name in _CONSTANT]
        self._gains = {some: gains.astype(self._dtype) for some, gains in terms.gains.items()}
        self.controller = terms.controller()  # that it computes
        self.reset()

    def reset(self) -> None:
        """Set states and last commands to zero; the next frame is the first of a period."""
        s, _, m = self._terms.sizes
        self._state: NDArray[Any] = np.zeros(s, dtype=self._dtype)
        self._last: NDArray[Any] = np.zeros(m, dtype=self._dtype)
        self._phase, self._missing = 0, NONE

    def step(
        self,
        y: FloatArray,
        fresh: Mapping[str, bool] | None = None,
        applied: ArrayLike | None = None,
    ) -> FloatArray:
        """Take y(k), what is new (all), and the applied u(k-1) (its own); return u(k)."""
        rows, read = self._terms.rows, self._terms.read[self._phase]
        due = frozenset(unit for unit, place in rows.items() if read[place.start])
        new = frozenset(
            unit
            for unit in due
            if (fresh is None or fresh.get(unit, True)) and np.all(np.isfinite(y[rows[unit]]))
        )
        if not self._terms.tabled and next(iter(rows)) not in new:
            return np.asarray(self._last, dtype=np.float64)
        phase = self._phase
        if self._terms.switched:
            phase, due = int(new < due), new
        self._missing = (self._missing - due) | (due - new)
        used = np.concatenate([np.r_[rows[unit]] for unit in rows if unit in new] or [[]])
        used = used.astype(np.intp)
        transition, innovation = (matrix[phase] for matrix in self._matrices[:2])
        last = self._last if applied is None else np.asarray(applied, dtype=self._dtype)
        signals = np.concatenate([self._state, last])
        measured: NDArray[Any] = np.zeros(len(read), dtype=self._dtype)
        measured[used] = y[used]
        errors = _added(np.hstack([measured[:, None], innovation * signals]))
        gains = self._gains[self._missing][phase]
        state = _added(transition * signals)
        n = len(gains)
        state[:n] = _added(np.hstack([state[:n, None], (gains * errors)[:, used]]))
        self._state = state
        self._last = _added(self._matrices[2] * np.concatenate([state, measured]))
        self._phase = (self._phase + 1) % len(self._terms.read)
        return np.asarray(self._last, dtype=np.float64)


def _added(terms: NDArray[Any]) -> NDArray[Any]:
    """Return the sums of rows, added one by one."""
    return np.asarray(np.add.accumulate(terms, axis=1)[:, -1])


def join(numbers: Sequence[SourceTerms], parts: Sequence[ModeDesign], count: int) -> SourceTerms:
    """Put controllers side by side, each as often as it has modes."""
    first, pairs = numbers[0], list(zip(numbers, parts, strict=True))
    if parts[0].copies == [tuple(range(count))]:
        return first
    s = sum(terms.sizes[0] * len(part.copies) for terms, part in pairs)
    transition, gains = np.zeros((1, s, s + count)), np.zeros((1, s, count))
    command, start = np.zeros((count, s + count)), 0
    for terms, modes in ((terms, list(copy)) for terms, part in pairs for copy in part.copies):
        states = list(range(start, start + terms.sizes[0]))
        start += terms.sizes[0]
        signals = [*states, *(s + mode for mode in modes)]
        transition[0][np.ix_(states, signals)] = terms.transition[0]
        gains[0][np.ix_(states, modes)] = terms.gains[NONE][0]
        command[np.ix_(modes, signals)] = terms.command
    return replace(
        first,
        transition=transition,
        innovation=np.zeros((1, count, s + count)),
        gains={NONE: gains},
        command=command,
        read=np.ones((1, count), dtype=np.bool_),
        rows={"measurements": slice(0, count)},
    )


def as_computed(design: Design, terms: SourceTerms) -> Written:
    """Return the controllers that a source makes, and the rounding of sums that it writes out."""
    if terms.switched:
        phases = [as_computed(design, terms.phase(k)) for k in (0, 1)]
        pairs = zip(design.controllers, phases, strict=True)
        return replace(
            phases[0],
            controllers={missing: written.controllers[NONE] for missing, written in pairs},
            checks=max((written.checks for written in phases), key=lambda c: c[0].value),
        )
    (s, _, m), K = terms.sizes, terms.gains[NONE]
    still = terms.transition[:, :, :s].copy()
    still[:, : K.shape[1]] += K @ terms.innovation[:, :, :s]
    checks: tuple[Check, ...] = ()
    if terms.applied:
        alone = StateSpace(A=still, B=np.zeros((s, 0)), C=np.zeros((0, s)), D=np.zeros((0, 0)))
        radius, name = alone.radius_per_frame, "spectral radius of the estimator alone"
        checks = (Check(name, radius, 1 - STABILITY_MARGIN, EIGENVALUES),)
    if terms.tabled:
        controllers = {missing: terms.controller(missing) for missing in terms.gains}
        return Written(controllers=controllers, checks=checks)
    # the command is rounded, applied, and known to the next frame: it is a further state
    controller, rows = terms.controller(), np.eye(s + m)
    both = np.vstack([rows[:s, :s], controller.C])
    zeros = np.zeros((m, s + m + controller.B.shape[1]))
    controller = replace(
        controller,
        A=both @ terms.transition[0],
        B=both @ K[0] + np.vstack([np.zeros_like(K[0]), controller.D]),
        C=rows[s:],
        D=zeros[:, s + m :],
    )
    roundoff = ROUNDOFF["single" if terms.single else "double"]
    return Written(
        controllers={NONE: controller},
        entry=replace(controller, B=np.hstack([both, rows[:, s:]]), D=zeros[:, : s + m]),
        variance=sums_variance(terms.whole, s, roundoff),
        signals=s,
        checks=checks,
    )


_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_TABLE = re.compile(r"static const [\w ]+ (\w+)(?:\[\w+\])+ = \{([^;]*)\};")
_NUMBER = re.compile(r"-?(?:0x[0-9a-f.]+p[+-]\d+|0\.0|\d+\b(?![.]))")
_SUM = re.compile(r"(?:const \w+_real ([nu])\d+|error\[count\+\+\]) =([^;]*);")
_TERM = re.compile(r"(-?)\s*(?:([cv])\[(\d+)\] \* )?([xnya])(\d+)")


def read_source(text: str, like: SourceTerms) -> SourceTerms:
    """Return the terms that the text of a source holds, of the sizes of others."""
    code = _COMMENT.sub("", text)
    code = re.sub(r"state->x\[(\d+)\](?! =)", r"n\1", code)
    code = re.sub(r"\by\[(\d+)\]", r"y\1", code)
    tables = {
        name: np.array([float.fromhex(v) if "x" in v else float(v) for v in _NUMBER.findall(body)])
        for name, body in _TABLE.findall(code)
    }
    (s, q, m), period = like.sizes, len(like.read)
    factors = {"c": tables.get("c", np.zeros(0)), "v": np.zeros((period, 0))}
    if "varying" in tables:
        factors["v"] = tables["varying"].reshape(period, -1)
    # rows of sums, with the columns of states, applied commands and readings
    sums: dict[str, list[FloatArray]] = {"n": [], "u": [], "": []}
    first = {"x": 0, "n": 0, "a": s, "y": s + m}
    for name, body in _SUM.findall(code):
        row = np.zeros((period, s + m + q))
        for sign, kind, place, signal, number in _TERM.findall(body):
            value = factors[kind][..., int(place)] if kind else 1.0
            row[:, first[signal] + int(number)] += -value if sign else value
        sums[name].append(row)
    predicted, command = (np.stack(sums[name], axis=1) for name in "nu")
    innovation = np.stack(sums[""], axis=1)[:, :, : s + m] if sums[""] else like.innovation
    gains, read = {NONE: predicted[:, :, s + m :]}, like.read
    if "first" in tables:
        gains, read = _read_gains(tables, like)
    return replace(
        like,
        transition=predicted[:, :, : s + m],
        innovation=innovation,
        gains=gains,
        command=np.delete(command[0], np.s_[s : s + m], axis=1),
        read=read,
    )


def _read_gains(
    tables: Mapping[str, FloatArray], like: SourceTerms
) -> tuple[dict[frozenset[str], FloatArray], BoolArray]:
    """Return the gains for each set of sensors that is missing, and which readings are due."""
    units, period = tuple(like.rows), len(like.read)
    n, read = like.gains[NONE].shape[1], np.zeros_like(like.read)
    due = tables["due"].astype(int)
    for i, rows in enumerate(like.rows.values()):
        read[:, rows] = (due >> i & 1 > 0)[:, None]
    first = tables["first"].astype(int).reshape(period, -1)
    out, terms = {}, replace(like, read=read)
    for missing in like.gains:
        mask = sum(1 << units.index(unit) for unit in missing)
        gains, due_now = np.zeros((period, n, read.shape[1])), used_readings(terms, missing)
        for phase in range(period):
            used = due_now[phase]
            start, count = first[phase, mask], n * int(np.count_nonzero(used))
            gains[phase][:, used] = tables["gains"][start : start + count].reshape(-1, n).T
        out[missing] = gains
    return out, read


def used_readings(terms: SourceTerms, missing: frozenset[str]) -> BoolArray:
    """Return which readings are due in each phase where some sensors are missing, (N, q)."""
    used = terms.read.copy()
    for unit in missing:
        used[:, terms.rows[unit]] = False
    return used


def count_gains(terms: SourceTerms) -> int:
    """Return how many gains stand in the table of a source."""
    readings = sum(int(np.count_nonzero(used_readings(terms, some))) for some in terms.gains)
    return readings * int(terms.gains[NONE].shape[1])
