"""Export of a filter of several sensors as C99 source, with its fall-backs in one table."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lbt_synth.design import Check, Design, FilterDesign
from lbt_synth.errors import ProblemError
from lbt_synth.interop.arithmetic_cost import FrameCost, frame_cost
from lbt_synth.interop.c.masked_terms import (
    MaskedSource,
    MaskedTerms,
    masked_rehearsal_error,
    masked_terms,
    prove_masked,
)
from lbt_synth.interop.c.source_text import exact_constant, render_source, wrap_sum
from lbt_synth.interop.export_checks import Exported, comment_text, provenance_lines, write_export
from lbt_synth.interop.target import Arithmetic
from lbt_synth.interop.written_loop import require_proved
from lbt_synth.validation import BoolArray, FloatArray

MOST_GAINS = 1_000_000  # in the table: 8 MB of memory, 25 MB of source
_LARGEST_ERROR = 0.01  # of the largest command


def export_masked(
    target: Path,
    design: Design,
    *,
    name: str,
    precision: str,
    gain_digest: str | None,
    arithmetic: Arithmetic,
) -> Exported:
    """Write a filter of several sensors, as :func:`export_c` does; all its checks have to pass."""
    single = precision == "single"
    exact = masked_terms(cast("FilterDesign", design))
    _require_short(exact)
    terms = exact.rounded() if single else exact
    error_single = masked_rehearsal_error(design, exact.rounded(), np.float32)
    error = error_single if single else masked_rehearsal_error(design, exact, np.float64)
    how = "a run in which each sensor is missing for a while"
    close = Check("commands in a rehearsal, difference", error, _LARGEST_ERROR, how)
    checks = (*prove_masked(design, terms), close)
    require_proved(checks, f"{precision} precision", "Try double precision.")
    lines = provenance_lines(design, gain_digest)
    if single:
        lines.append(("precision", f"single: commands within {error:.1e} of the largest one"))
    cost = _frame_cost(design, terms)
    header = target.with_suffix(".h")
    source, declarations = render_source(
        "masked",
        single=single,
        p=name,
        P=name.upper(),
        provenance=lines,
        cost=cost,
        header_name=header.name,
        gain_digest=gain_digest,
        **_written_out(terms, single=single),
    )
    dtype = np.float32 if single else np.float64
    return write_export(
        {target: source.encode("ascii"), header: declarations.encode("ascii")},
        target="c",
        arithmetic=replace(
            arithmetic,
            sums="each sum from left to right, then the errors of readings in order",
            state="estimator: x = A x + B u_applied + K (y - C x - D u_applied), u = H x",
            clipping="yours: the filter takes the applied commands",
        ),
        checks=checks,
        gain_digest=gain_digest,
        form="estimator",
        precision=precision,
        period=len(terms.read),
        sensors=list(terms.rows),
        error=error,
        error_single=error_single,
        start=lambda _: MaskedSource(terms, dtype),
        cost=cost,
    )


def _require_short(terms: MaskedTerms) -> None:
    """Refuse a table of gains that no computer should have to hold."""
    gains = sum(np.count_nonzero(_used(terms, some)) for some in terms.gains)
    count = gains * next(iter(terms.gains.values())).shape[1]
    if count > MOST_GAINS:
        raise ProblemError(
            f"the gains of all phases and fall-backs must be at most {MOST_GAINS:,} numbers in C; "
            f"got {count:,}, in a period of {len(terms.read)} frames. Choose rates with a shorter "
            "common period, or leave out channels."
        )


def _used(terms: MaskedTerms, missing: frozenset[str]) -> BoolArray:
    """Return which readings are due in each phase where some sensors are missing, (N, q)."""
    used = terms.read.copy()
    for unit in missing:
        used[:, terms.rows[unit]] = False
    return used


def _written_out(terms: MaskedTerms, *, single: bool) -> dict[str, Any]:
    """Return what the templates print of the terms."""
    writer = _SumWriter(len(terms.command[0]), exact_constant(0.0, single=single))
    transition = writer.write("A B", terms.transition, "x{}", 18)
    innovation = writer.write("C D", terms.innovation, "x{}", 24, first="y[{}]")
    command = writer.write("H", terms.command[None], "state->x[{}]", 26)
    return {
        "n": len(transition),
        "estimates": next(iter(terms.gains.values())).shape[1],
        "q": len(innovation),
        "m": len(command),
        "period": len(terms.read),
        "frame_s": terms.dt_s,
        "units": _describe_units(terms),
        "due": [str(mask) for mask in _due_masks(terms)],
        "constants": writer.constants,
        "varying": [place for place, _ in writer.varying],
        "varying_values": np.array([v for _, v in writer.varying]).T.tolist(),
        "used": {kind: sorted(numbers) for kind, numbers in writer.used.items()},
        "transition": transition,
        "innovation": innovation,
        "command": command,
        **_gain_table(terms, single=single),
    }


class _SumWriter:
    """Writes each non-zero term of sums; collects constants, and what changes with the phase."""

    def __init__(self, states: int, zero: str) -> None:
        self._states, self._zero = states, zero
        self.constants: list[tuple[str, float]] = []
        self.varying: list[tuple[str, FloatArray]] = []
        self.used: dict[str, set[int]] = {"x": set(), "a": set()}

    def write(
        self, name: str, matrices: FloatArray, state: str, column: int, first: str = ""
    ) -> list[str]:
        """Return the sum of each row of matrices (N, r, s or s + m), in terms of its signals."""
        sums = []
        for i in range(matrices.shape[1]):
            terms = [("+", first.format(i))] if first else []
            for j in np.flatnonzero(matrices[:, i].any(axis=0)).tolist():
                kind, number = ("x", j) if j < self._states else ("a", j - self._states)
                signal = state.format(j) if kind == "x" else f"a{number}"
                if signal != f"state->x[{j}]":  # a state after the frame
                    self.used[kind].add(number)
                terms.append(self._term(f"[{name}][{i}][{j}]", matrices[:, i, j], signal))
            sums.append(wrap_sum(terms or [("+", self._zero)], column))
        return sums

    def _term(self, place: str, values: FloatArray, signal: str) -> tuple[str, str]:
        value = float(values[0])
        if np.any(values != value):
            self.varying.append((place, values))
            return "+", f"v[{len(self.varying) - 1}] * {signal}"
        if abs(value) == 1:
            return "+" if value > 0 else "-", signal
        self.constants.append((place, value))
        return "+", f"c[{len(self.constants) - 1}] * {signal}"


def _describe_units(terms: MaskedTerms) -> list[dict[str, Any]]:
    """Return name, identifier, measurements and period of each sensor and channel."""
    words = [re.sub(r"[^A-Z0-9]+", "_", unit.upper())[:24].strip("_") for unit in terms.rows]
    if len(set(words)) < len(words) or not all(words):  # names that differ in other letters alone
        words = [f"{word}_{i}".strip("_") for i, word in enumerate(words)]
    return [
        {
            "name": comment_text(unit),
            "identifier": word,
            "bit": 1 << i,
            "rows": list(range(own.start, own.stop)),
            "first": own.start,
            "last": own.stop - 1,
            "every": len(terms.read) // np.count_nonzero(terms.read[:, own.start]),
        }
        for i, (word, (unit, own)) in enumerate(zip(words, terms.rows.items(), strict=True))
    ]


def _due_masks(terms: MaskedTerms) -> list[int]:
    """Return which sensors and channels are due in each phase, as sums of powers of two."""
    places = [own.start for own in terms.rows.values()]
    masks: list[int] = (terms.read[:, places] @ (1 << np.arange(len(places)))).tolist()
    return masks


def _gain_table(terms: MaskedTerms, *, single: bool) -> dict[str, Any]:
    """Return the gains, column by column, and where those of each phase and set begin."""
    units = tuple(terms.rows)
    sets = [
        frozenset(unit for i, unit in enumerate(units) if mask >> i & 1)
        for mask in range(1 << len(units))
    ]
    used = [_used(terms, some) for some in sets]
    blocks, first, count = [], [], 0
    for phase in range(len(terms.read)):
        begins = []
        for mask, some in enumerate(sets):
            columns = terms.gains[some][phase][:, used[mask][phase]].T
            written = [[exact_constant(v, single=single) for v in own] for own in columns.tolist()]
            begins.append(str(count))
            count += columns.size
            if written:
                blocks.append((phase, mask, written))
        first.append(begins)
    return {"gain_blocks": blocks, "first": first, "gain_count": count, "sets": len(sets)}


def _frame_cost(design: Design, terms: MaskedTerms) -> FrameCost:
    """Count the arithmetic of a frame in which all sensors are read."""
    writes, factors, stored = 0, 0, 0
    for part in (terms.transition, terms.innovation, terms.command[None]):
        same = np.all(part == part[0], axis=0)
        there = part.any(axis=0)
        multiplied = there & ~(same & (np.abs(part[0]) == 1))
        writes += int(np.count_nonzero(there))
        factors += int(np.count_nonzero(multiplied))
        stored += int(np.count_nonzero(multiplied & same))
        stored += len(part) * int(np.count_nonzero(multiplied & ~same))
    (period, q), (m, s), n = terms.read.shape, terms.command.shape, design.problem.n_states
    gains = sum(n * int(np.count_nonzero(_used(terms, some))) for some in terms.gains)
    dense = frame_cost(design.controller.phase(0))
    return replace(
        dense,
        form="straight line",
        multiplications=factors + n * q,
        additions=writes - s - m + n * q,  # an innovation begins with its reading
        coefficients=stored + gains,
        states=s + m,
        dense_coefficients=period * dense.dense_coefficients,
    )
