"""The target C: C99 source and header, from the templates in this folder, without a library."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.interop.c.terms import (
    NONE,
    RunningSource,
    SourceTerms,
    as_computed,
    controller_terms,
    count_gains,
    join,
    read_source,
    source_terms,
    used_readings,
)
from lbt_synth.interop.pipeline import Target, comment_text
from lbt_synth.linear import Controller
from lbt_synth.linear.controller import as_controller
from lbt_synth.storage.rows import column, table_row
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, choice

MOST_TERMS = 100_000  # that are written out: 10 MB of source
MOST_GAINS = 1_000_000  # in the table: 8 MB of memory, 25 MB of source
_IDENTIFIER = re.compile(r"[A-Za-z](?:_?[A-Za-z0-9])*")
_SOURCE = re.compile(r"[A-Za-z0-9._+-]*\.c")
_LONGEST = 25  # C99 distinguishes identifiers by 31 characters, six of them "_reset"


@table_row
class FrameCost:
    """Arithmetic of one frame of a controller, as exported to C."""

    multiplications: int = column(
        "multiplications per frame",
        help="Of the exported source; factors of 1 and -1 are no multiplications",
    )
    additions: int = column("additions per frame", help="Of the exported source")


def frame_cost(design: Design | Controller | SourceTerms) -> FrameCost:
    """Count the arithmetic of one frame of the C source, in which all is read."""
    terms = design if isinstance(design, SourceTerms) else controller_terms(as_controller(design))
    out, table = _written_out(terms), terms.gains[NONE][0].size if terms.tabled else 0
    sums = "".join([*out["errors"], *out["states"], *out["commands"]])
    return FrameCost(
        multiplications=sums.count(" * ") + table,
        additions=sums.count(" + ") + sums.count(" - ") + table,
    )


def _round(designs: Sequence[Design], *, form: str, precision: str, **_: Any) -> list[SourceTerms]:
    """Return the terms of designs, in a form and a precision."""
    choice(precision, "precision", ("double", "single"))
    numbers = []
    for design in designs:
        several = bool(design.other_sensors)
        kind = ("estimator" if several else "plain") if form is None else form
        choice(kind, "form", ("plain", "estimator"))
        if several and kind == "plain":
            raise ProblemError(
                "a design of several sensors is exported in estimator form alone, which is given "
                "the applied commands; got form=plain. Leave it out."
            )
        terms = source_terms(design, form=kind)
        count = count_gains(terms) if terms.tabled else int(np.count_nonzero(terms.whole))
        most = MOST_GAINS if terms.tabled else MOST_TERMS
        if count > most:
            raise ProblemError(
                f"a controller must have at most {most:,} numbers in C; got {count:,}, in "
                f"a period of {len(terms.read)} frames. Design with fewer states, choose rates "
                "with a shorter common period, or leave out channels."
            )
        numbers.append(terms.rounded() if precision == "single" else terms)
    return numbers


def _write(
    place: Path,
    terms: SourceTerms,
    _: Design,
    origin: Sequence[str],
    *,
    name: str | None,
    gain_digest: str | None,
    **__: Any,
) -> dict[Path, bytes]:
    """Return source and header."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    if not _SOURCE.fullmatch(place.name):
        raise OutputError(
            "C source must end in .c, and its name have letters, digits and . _ + - only; got "
            f"{place.name!r}.",
            path=place,
        )
    prefix = place.stem if name is None else name
    # these are identifiers of C and C++ that no standard reserves
    if not (isinstance(prefix, str) and _IDENTIFIER.fullmatch(prefix) and len(prefix) <= _LONGEST):
        raise ProblemError(
            f"the prefix of the C names must begin with a letter, hold letters, digits and single "
            f"underscores between them, and have at most {_LONGEST} characters; got {prefix!r}. "
            "Give another name."
        )
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "constant": lambda value: _exact_constant(value, single=terms.single),
        "count": count_text,
        "lines": lambda texts: textwrap.indent(textwrap.fill(", ".join(texts)), "    "),
    }
    header = place.with_suffix(".h")
    values = {
        "p": prefix,
        "P": prefix.upper(),
        "origin": origin,
        "header_name": header.name,
        "gain_digest": gain_digest,
        "type": "float" if terms.single else "double",
        "largest": "FLT_MAX" if terms.single else "DBL_MAX",
        "inputs": f"const {prefix}_real *y, "
        + "const unsigned char *fresh, " * terms.masked
        + f"const {prefix}_real *applied, " * terms.applied,
        **_described(terms),
        **_written_out(terms),
        **_tables(terms),
    }
    source, declarations = (
        environment.get_template(f"controller.{ending}.jinja").render(values) for ending in "ch"
    )
    return {place: source.encode("ascii"), header: declarations.encode("ascii")}


def _exact_constant(value: float, *, single: bool) -> str:
    """Return an exact constant of a type; a value of single precision is already rounded."""
    return (value.hex() if value else "0.0") + ("f" if single else "")


def _described(terms: SourceTerms) -> dict[str, Any]:
    """Return what the comments, the header and the branches of the template need."""
    (n, q, m), form = terms.sizes, "plain: x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k)"
    if terms.applied:
        form = "estimator: x(k+1) = A x(k) + L u_applied(k-1) + B y(k), u(k) = C x(k+1)"
    if terms.tabled:
        form = "estimator: x = A x + L u_applied + K (y + G x + J u_applied), u = C x"
    return {
        "n": n,
        "q": q,
        "m": m,
        "form": form,
        **{name: getattr(terms, name) for name in ("masked", "tabled", "applied")},
        "estimates": terms.gains[NONE].shape[1],
        "period": len(terms.read),
        "frame_s": terms.dt_s,
        "cost": frame_cost(terms),
        "units": _describe_units(terms),
    }


def _describe_units(terms: SourceTerms) -> list[dict[str, Any]]:
    """Return name, identifier, measurements and period of each sensor and channel."""
    words = [re.sub(r"[^A-Z0-9]+", "_", unit.upper())[:24].strip("_") for unit in terms.rows]
    if len(set(words)) < len(words) or not all(words):  # names that differ in other letters alone
        words = [f"{word}_{i}".strip("_") for i, word in enumerate(words)]
    return [
        {
            "name": comment_text(unit),
            "identifier": word,
            "bit": 1 << i,
            "rows": list(range(rows.start, rows.stop)),
            "first": rows.start,
            "last": rows.stop - 1,
            "every": len(terms.read) // np.count_nonzero(terms.read[:, rows.start]),
        }
        for i, (word, (unit, rows)) in enumerate(zip(words, terms.rows.items(), strict=True))
    ]


def _written_out(terms: SourceTerms) -> dict[str, Any]:
    """Return the sums of a frame with each non-zero term; factors of 1 and -1 are signs."""
    s, q, m = terms.sizes
    constants: list[tuple[str, float]] = []
    varying: list[tuple[str, list[float]]] = []  # what changes from phase to phase
    states, applied, readings = (
        [f"{kind}{j}" for j in range(size)] for kind, size in zip("xay", (s, m, q), strict=True)
    )

    def term(place: str, values: FloatArray, signal: str) -> tuple[str, str]:
        value = float(values[0])
        if np.any(values != value):
            varying.append((place, values.tolist()))
            return "+", f"v[{len(varying) - 1}] * {signal}"
        if abs(value) == 1:
            return "+" if value > 0 else "-", signal
        constants.append((place, value))
        return "+", f"c[{len(constants) - 1}] * {signal}"

    def sums(
        names: Sequence[str], matrix: FloatArray, signals: Sequence[str], begin: str = ""
    ) -> list[str]:
        """Return a sum for each row of (N, rows, columns); columns have the names of matrices."""
        out = []
        for i in range(matrix.shape[1]):
            some = [("+", begin.format(i))] if begin else []
            used_columns = np.flatnonzero(matrix[:, i].any(axis=0)).tolist()
            some += [term(names[j].format(i), matrix[:, i, j], signals[j]) for j in used_columns]
            zero = _exact_constant(0.0, single=terms.single)
            out.append(_wrap_sum(some or [("+", zero)]))
        return out

    def columns(**sizes: int) -> list[str]:
        return [f"{name}[{{}}][{j}]" for name, size in sizes.items() for j in range(size)]

    out: dict[str, Any] = {"errors": []}
    transition, predicting = terms.transition, [*states, *applied]
    if terms.tabled:
        out["errors"] = sums(columns(G=s, J=m), terms.innovation, predicting, begin="y[{}]")
    else:
        transition = np.concatenate([transition, terms.gains[NONE]], axis=2)
    names = columns(A=s, L=m, B=q)
    out["states"] = sums(names, transition, [*predicting, *readings])
    new = [f"state->x[{j}]" if terms.tabled else f"n{j}" for j in range(s)]
    out["commands"] = sums(columns(C=s, D=q), terms.command[None], [*new, *readings])
    text = "".join([*out["errors"], *out["states"], *out["commands"]])
    named = {
        kind: sorted({int(number) for number in re.findall(rf"\b{kind}(\d+)", text)})
        for kind in "xya"
    }
    return {**out, "constants": constants, "varying": varying, "used": named}


def _wrap_sum(terms: Sequence[tuple[str, str]]) -> str:
    """Return a sum of (sign, term) on lines of its own, none of which breaks a term."""
    text = " ".join(f"{sign} {term}".replace(" ", "\0") for sign, term in terms)
    text = text.removeprefix("+\0").replace("-\0", "-", text.startswith("-"))
    return "\n" + textwrap.indent(textwrap.fill(text), "        ").replace("\0", " ")


def _tables(terms: SourceTerms) -> dict[str, Any]:
    """Return the gains of each phase and of each set that is missing, and where they begin."""
    if not terms.tabled:
        return {}
    units, gains = tuple(terms.rows), []
    sets = [
        frozenset(unit for i, unit in enumerate(units) if mask >> i & 1)
        for mask in range(1 << len(units))
    ]
    used = [used_readings(terms, missing) for missing in sets]
    first, count = [], 0
    for phase in range(len(terms.read)):
        begins = []
        for mask, missing in enumerate(sets):
            columns = terms.gains[missing][phase][:, used[mask][phase]].T.tolist()
            begins.append(str(count))
            count += sum(map(len, columns))
            gains += [(f"phase {phase}, missing {mask}", column) for column in columns]
        first.append(begins)
    places = [rows.start for rows in terms.rows.values()]
    due = map(str, (terms.read[:, places] @ (1 << np.arange(len(places)))).tolist())
    return {"gains": gains, "count": count, "due": list(due), "first": first, "sets": len(sets)}


def _facts(terms: SourceTerms, **_: Any) -> dict[str, Any]:
    """Return what the certificate says of the source."""
    form = {"form": "estimator" if terms.applied else "plain"}
    period = {"period": len(terms.read)} if terms.tabled else {}
    return form | period | ({"sensors": list(terms.rows)} if terms.masked else {})


TARGET = Target(
    precision="double",
    options={
        "form": None,
        "precision": "double",
        "name": None,
        "modes": None,
        "other_gain": None,
    },
    round=_round,
    write=_write,
    read=lambda files, like: read_source(next(iter(files.values())).decode("ascii"), like),
    computed=as_computed,
    start=lambda terms, _: RunningSource(terms),
    join=join,
    facts=_facts,
    hint="Try double precision.",
    endings=(".c",),
    beside=(".h",),
    modal=False,
    reads_others=True,
)
