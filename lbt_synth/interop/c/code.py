"""The C code of a controller: its header and its source, from the templates in this folder."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.interop.arithmetic_cost import frame_cost, has_straight_line_form
from lbt_synth.linear import Controller

_WIDTH = 96


def render_code(
    prefix: str,
    header_name: str,
    controller: Controller,
    provenance: Sequence[tuple[str, str]],
    *,
    single: bool,
    gain_digest: str | None,
) -> tuple[str, str]:
    """Return the source and the header; ``provenance`` begins the comment of both."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    def constant(value: float) -> str:
        """Exact constant of the type; a value of single precision is already rounded."""
        return (value.hex() if value else "0.0") + ("f" if single else "")

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"constant": constant, "count": _count}
    values = {
        "p": prefix,
        "P": prefix.upper(),
        "n": controller.n_states,
        "q": controller.B.shape[1],
        "m": len(controller.C),
        "type": "float" if single else "double",
        "controller": controller,
        "provenance": provenance,
        "cost": frame_cost(controller),
        "header_name": header_name,
        "gain_digest": gain_digest,
        "straight_line": _write_out(prefix, controller, zero=constant(0.0))
        if has_straight_line_form(controller)
        else None,
    }
    source, header = (
        environment.get_template(f"controller.{ending}.jinja").render(values) for ending in "ch"
    )
    return source, header


def _write_out(prefix: str, controller: Controller, *, zero: str) -> dict[str, Any]:
    """Return one frame with each non-zero term written out; factors of 1 and -1 are signs."""
    n = controller.n_states
    coefficients: list[tuple[str, float]] = []
    sums: dict[str, str] = {}
    # a command is computed from the new state n0, n1, ...
    for result, state, on_state, on_y in (("n", "x", "A", "B"), ("u", "n", "C", "D")):
        rows = np.hstack([getattr(controller, on_state), getattr(controller, on_y)])
        for i, row in enumerate(rows.tolist()):
            terms: list[tuple[str, str]] = []
            for j in np.flatnonzero(row):
                name, place = f"{state}{j}", f"{on_state}[{i}][{j}]"
                if j >= n:
                    name, place = f"y{j - n}", f"{on_y}[{i}][{j - n}]"
                factor = ""
                if abs(row[j]) != 1:
                    factor = f"c[{len(coefficients)}] * "
                    coefficients.append((place, row[j]))
                terms.append(("-" if row[j] == -1 else "+", factor + name))
            start = f"    const {prefix}_real {result}{i} ="
            sums[f"{result}{i}"] = _wrap(terms or [("+", zero)], len(start))
    return {
        "states": np.flatnonzero(controller.A.any(axis=0)).tolist(),
        "measurements": np.flatnonzero(
            np.vstack([controller.B, controller.D]).any(axis=0)
        ).tolist(),
        "coefficients": coefficients,
        "sums": sums,
    }


def _wrap(terms: list[tuple[str, str]], column: int) -> str:
    """Return a sum that begins at a column, its terms wrapped over lines."""
    text = " ".join(f"{sign} {term}".replace(" ", "\0") for sign, term in terms)
    text = text.removeprefix("+\0").replace("-\0", "-", text.startswith("-"))
    begin, more = " " * (column + 1), " " * 8
    wrapped = textwrap.fill(
        text, _WIDTH - 1, initial_indent=begin, subsequent_indent=more, break_long_words=False
    )
    return wrapped[column:].replace("\0", " ")


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + ("" if number == 1 else "s")
