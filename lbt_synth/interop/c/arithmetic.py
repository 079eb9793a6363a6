"""The arithmetic of exported C source: read back from its text, run, and proved in the loop.

The controllers of all modes are one in the source; each is proved alone.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from lbt_synth.design import Check, Design
from lbt_synth.interop.export_checks import MatrixForm, rehearsal_error
from lbt_synth.interop.modes import AllModes
from lbt_synth.interop.written_loop import matrix_rounding, prove_written
from lbt_synth.linear import Controller
from lbt_synth.linear.state_space import LinearSystem
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.validation import FloatArray


class SourceTerms(MatrixForm):
    """A controller stepped as its source is written: term by term, each rounded.

    In each row of ``[A, B]`` and ``[C, D]`` the terms are added from left to right, as one
    statement of the straight-line source does and as the loops over whole matrices do; terms that
    are zero change nothing. Where applied commands are ``given``, the last inputs take its own.
    """

    def __init__(self, written: LinearSystem, dtype: Any, *, given: bool = False) -> None:
        self._last = np.zeros(len(written.C) if given else 0)
        super().__init__(written, dtype)

    def reset(self) -> None:
        """Set the state and the last commands to zero."""
        super().reset()
        self._last = np.zeros_like(self._last)

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        u = super().step(np.concatenate([y, self._last]))
        self._last = u[: self._last.size]
        return u

    def _combine(self, on_state: NDArray[Any], on_y: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        terms = np.hstack([on_state * self._state, on_y * y])
        return np.asarray(np.add.accumulate(terms, axis=1)[:, -1])


def prove_source(
    design: Design, states: FloatArray, commands: FloatArray, roundoff: float
) -> tuple[Check, ...]:
    """Check the loop around the coefficients of a source, as :func:`read_source` returns them.

    The estimator form must also be stable by itself. A design without a loop has no checks.
    """
    if design.hardware is None:
        return ()
    n, m, q = len(states), len(commands), design.controller.B.shape[1]
    A, B, L = np.hsplit(states, [n, n + q])
    C, D = np.hsplit(commands, [n])
    rows, whole = np.eye(n + m), np.vstack([states[:, : n + q], commands])
    alone: tuple[Check, ...] = ()
    written = Controller(A=A, B=B, C=C, D=D, dt_s=design.controller.dt_s)
    entry = replace(written, B=rows[:n], D=rows[n:])
    if L.size:
        # the commands, which come back as the applied ones, are further states
        radius = float(np.max(np.abs(np.linalg.eigvals(A))))
        name = "spectral radius of the estimator alone"
        alone = (Check(name, radius, 1 - STABILITY_MARGIN, "eigenvalues"),)
        read = np.vstack([rows[:n, :n], C])
        whole = np.block([[states], [commands, np.zeros((m, m))]])
        written = replace(
            written,
            A=read @ np.hstack([A, L]),
            B=read @ B,
            C=rows[n:],
        )
        entry = replace(written, B=np.hstack([read, rows[:, n:]]), D=np.zeros((m, n + m)))
    rounding = matrix_rounding(whole, entry, rows[:n, : written.n_states], roundoff)
    return (*alone, *prove_written(design, written, rounding))


_SIZE = re.compile(r"#define \w+_(STATES|MEASUREMENTS|COMMANDS) (\d+)\n")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_CONSTANT = re.compile(r"-?(?:0x[0-9a-f.]+p[+-]\d+|0\.0)")
_MATRIX = re.compile(r"static const \w+_real (\w)\[[^=]*=([^;]*);")
_LIST = re.compile(r"static const \w+_real c\[\d+\] =([^;]*);")
_SUM = re.compile(r"const \w+_real ([nu])(\d+) =([^;]*);")
_TERM = re.compile(r"(-?)\s*(?:c\[(\d+)\] \* )?([xnya])(\d+)")


def read_source(source: str, header: str) -> tuple[FloatArray, FloatArray]:
    """Return the factors in the new state and in the commands, from the texts of two files.

    Those of the state are (n, n + q), or (n, n + q + m) with the applied commands; those of the
    commands (m, n + q) act on the new state and on the measurements.
    """
    sizes = {name: int(count) for name, count in _SIZE.findall(header)}
    n, q, m = (sizes[name] for name in ("STATES", "MEASUREMENTS", "COMMANDS"))
    text = _COMMENT.sub("", source)
    columns = {name: _numbers(body) for name, body in _MATRIX.findall(text)}
    if "A" in columns:  # whole matrices, by columns
        rows = {
            name: values.reshape(-1, m if name in "CD" else n).T for name, values in columns.items()
        }
        entries = [rows[name] for name in "ABL" if name in rows]
        return np.hstack(entries), np.hstack([rows["C"], rows["D"]])
    factors = "".join(_LIST.findall(text))
    c = _numbers(factors)
    first = {"x": 0, "n": 0, "y": n, "a": n + q}  # columns of the signals
    whole = {"n": np.zeros((n, n + q + m)), "u": np.zeros((m, n + q + m))}
    for result, row, terms in _SUM.findall(text):
        for sign, factor, signal, index in _TERM.findall(terms):
            value = c[int(factor)] if factor else 1.0
            column = first[signal] + int(index)
            whole[result][int(row), column] += -value if sign else value
    applied = " *applied" in text
    return whole["n"][:, : n + q + (m if applied else 0)], whole["u"][:, : n + q]


def _numbers(text: str) -> FloatArray:
    return np.array([float.fromhex(value) for value in _CONSTANT.findall(text)])


_Places = NDArray[np.intp]


class _Copy(NamedTuple):
    """Where one controller stands in the whole: its states, inputs and commands."""

    states: _Places
    inputs: _Places
    commands: _Places


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joined:
    """Controllers side by side; the last ``applied`` inputs take the applied commands."""

    whole: AllModes
    parts: Sequence[Controller]
    controller: Controller
    applied: int
    copies: list[list[_Copy]]  # of each part

    def rehearsal_error(self, kind: Any) -> float:
        """Return the largest error of a part in the arithmetic of the source."""
        given = self.applied > 0
        return max(
            rehearsal_error(part.design, SourceTerms(own, kind, given=given))
            for part, own in zip(self.whole.parts, self.parts, strict=True)
        )

    def start(self, kind: Any) -> SourceTerms:
        """Return the whole in the arithmetic of the source."""
        return SourceTerms(self.controller, kind, given=self.applied > 0)

    def prove(self, states: FloatArray, commands: FloatArray, roundoff: float) -> tuple[Check, ...]:
        """Check the loop of each part with the coefficients of a source; equal copies once."""
        checks: list[Check] = []
        for part, copies in zip(self.whole.parts, self.copies, strict=True):
            found = {}
            for own in copies:
                every = np.concatenate([own.states, len(states) + own.inputs])
                measured = every[every < commands.shape[1]]
                pair = states[np.ix_(own.states, every)], commands[np.ix_(own.commands, measured)]
                found[pair[0].tobytes() + pair[1].tobytes()] = pair
            for pair in found.values():
                checks += self.whole.name_checks(part, prove_source(part.design, *pair, roundoff))
        return tuple(checks)


def join(whole: AllModes, controllers: Sequence[Controller], *, applied: bool) -> Joined:
    """Put the controllers of the parts side by side, each as often as it has modes.

    The last inputs of each are the applied commands, if there are any.
    """
    if len(whole.parts) == 1 and whole.parts[0].copies == [tuple(range(whole.count))]:
        (only,) = controllers
        n, (m, q) = only.n_states, only.D.shape
        copy = _Copy(np.arange(n), np.arange(q), np.arange(m))
        taken = m if applied else 0
        return Joined(
            whole=whole, parts=controllers, controller=only, applied=taken, copies=[[copy]]
        )
    places, count = [], 0
    for part, own in zip(whole.parts, controllers, strict=True):
        copies = []
        for modes in map(np.array, part.copies):
            inputs = np.concatenate([modes, whole.count + modes]) if applied else modes
            copies.append(_Copy(np.arange(count, count + own.n_states), inputs, modes))
            count += own.n_states
        places.append(copies)
    m = whole.count
    B, C = np.zeros((count, 2 * m if applied else m)), np.zeros((m, count))
    D = np.zeros((m, B.shape[1]))
    pairs = [(own, copy) for own, some in zip(controllers, places, strict=True) for copy in some]
    for own, copy in pairs:
        B[np.ix_(copy.states, copy.inputs)] = own.B
        C[np.ix_(copy.commands, copy.states)] = own.C
        D[np.ix_(copy.commands, copy.inputs)] = own.D
    A = block_diag(*(own.A for own, _ in pairs))
    joined = Controller(A=A, B=B, C=C, D=D, dt_s=controllers[0].dt_s)
    return Joined(
        whole=whole,
        parts=controllers,
        controller=joined,
        applied=m if applied else 0,
        copies=places,
    )
