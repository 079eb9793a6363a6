"""The controllers of all modes as one, for one source; each is proved alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from lbt_synth.design import Check
from lbt_synth.interop.c.arithmetic import SourceTerms, prove_source
from lbt_synth.interop.export_checks import rehearsal_error
from lbt_synth.interop.modes import AllModes
from lbt_synth.linear import Controller
from lbt_synth.validation import FloatArray

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
