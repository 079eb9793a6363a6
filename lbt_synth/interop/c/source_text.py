"""Text of C99 source: the templates in this folder, exact constants, and sums over lines."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray

_WIDTH = 96
_LARGEST_SINGLE = float(np.finfo(np.float32).max)


def round_to_single(matrices: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Round named coefficients to single precision; refuse those that do not fit."""
    for name, values in matrices.items():
        largest = float(np.max(np.abs(values), initial=0.0))
        if largest > _LARGEST_SINGLE:
            raise ProblemError(
                f"the coefficients must be below {_LARGEST_SINGLE:.3g} in single precision; got "
                f"{largest:.3g} in {name}. Try double precision, or scale the states."
            )
    return {name: values.astype(np.float32).astype(float) for name, values in matrices.items()}


def exact_constant(value: float, *, single: bool) -> str:
    """Return an exact constant of a type; a value of single precision is already rounded."""
    return (value.hex() if value else "0.0") + ("f" if single else "")


def render_source(template: str, *, single: bool, **values: Any) -> tuple[str, str]:
    """Return source and header from the templates of a name, in a precision."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "constant": lambda value: exact_constant(value, single=single),
        "count": count_text,
        "lines": _fill_lines,
    }
    values |= {
        "type": "float" if single else "double",
        "largest": "FLT_MAX" if single else "DBL_MAX",
    }
    source, header = (
        environment.get_template(f"{template}.{ending}.jinja").render(values) for ending in "ch"
    )
    return source, header


def wrap_sum(terms: Sequence[tuple[str, str]], column: int) -> str:
    """Return a sum of (sign, term) that begins at a column, its terms wrapped over lines."""
    text = " ".join(f"{sign} {term}".replace(" ", "\0") for sign, term in terms)
    text = text.removeprefix("+\0").replace("-\0", "-", text.startswith("-"))
    begin, more = " " * (column + 1), " " * 8
    wrapped = textwrap.fill(
        text, _WIDTH - 1, initial_indent=begin, subsequent_indent=more, break_long_words=False
    )
    return wrapped[column:].replace("\0", " ")


def _fill_lines(values: Iterable[str]) -> str:
    """Return entries of an array, indented, over as many lines as they need."""
    return textwrap.fill(", ".join(values), _WIDTH, initial_indent="    ", subsequent_indent="    ")
