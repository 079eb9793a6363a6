"""The arithmetic of exported C source: run, and proved in the loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lbt_synth.design import Check, Design
from lbt_synth.interop.export_checks import MatrixForm
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
