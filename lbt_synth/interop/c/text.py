"""The text of the C source of a controller, and of its header."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lbt_synth.interop.cost import frame_cost, written_out
from lbt_synth.linear import Controller
from lbt_synth.validation import FloatArray

Lines = Sequence[tuple[str, str]]
_WIDTH = 96
_NOTES = """\
 * One frame: call {p}_step once with the measurements y(k); it leaves the commands in u.
 * Call {p}_reset before the first frame and whenever the loop has been open: the controller
 * alone may be unstable, and it knows the commands that it gave, not those that were applied.
 * Each loop has its own {p}_state; there is no other memory, so threads need no lock as long as
 * each has its own. y and u may be the same array. Nothing is allocated, no library is called,
 * and every frame takes the same operations.
 * A measurement that is not a number or infinite makes the state so, for good: test y before
 * the call, or u after it, and reset. Where the measurements become zero, states can decay to
 * subnormal numbers, which some processors handle slowly; let yours flush them to zero if the
 * longest frame counts.
"""


def header_text(
    prefix: str, controller: Controller, lines: Lines, *, single: bool, gain_digest: str | None
) -> str:
    """Return the header: sizes, types, declarations."""
    P, q, m = prefix.upper(), controller.B.shape[1], len(controller.C)
    sha = "" if gain_digest is None else f'#define {P}_GAIN_SHA256 "{gain_digest}"\n'
    return (
        comment(prefix, controller, lines, single=single)
        + f"""#ifndef {P}_H
#define {P}_H

#ifdef __cplusplus
extern "C" {{
#endif

#define {P}_STATES {controller.n_states}
#define {P}_MEASUREMENTS {q}
#define {P}_COMMANDS {m}
#define {P}_FRAME_S {controller.dt_s!r}
{sha}
typedef {_type(single)} {prefix}_real;

typedef struct {{
    {prefix}_real x[{P}_STATES];
}} {prefix}_state;

/* Set the state to zero. */
void {prefix}_reset({prefix}_state *state);

/* Take the {_count(q, "measurement")} y(k) and compute the {_count(m, "command")} u(k). */
void {prefix}_step({prefix}_state *state, const {prefix}_real *y, {prefix}_real *u);

#ifdef __cplusplus
}}
#endif

#endif
"""
    )


def source_text(
    prefix: str, header: str, controller: Controller, lines: Lines, *, single: bool
) -> str:
    """Return the source: coefficients, reset, step; ``header`` is the name of the header."""
    P = prefix.upper()
    table, step = (_straight_line if written_out(controller) else _loops)(
        prefix, controller, single
    )
    return (
        comment(prefix, controller, lines, single=single)
        + f"""#include "{header}"

{table}void {prefix}_reset({prefix}_state *state)
{{
    int i;

    for (i = 0; i < {P}_STATES; i++) {{
        state->x[i] = {_number(0.0, single)};
    }}
}}

void {prefix}_step({prefix}_state *state, const {prefix}_real *y, {prefix}_real *u)
{{
{step}}}
"""
    )


def comment(prefix: str, controller: Controller, lines: Lines, *, single: bool) -> str:
    """Return the comment that begins both files."""
    cost = frame_cost(controller)
    facts = [
        *lines,
        ("form", "x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k), x(0) = 0"),
        (
            "sizes",
            f"{_count(controller.n_states, 'state')}, "
            f"{_count(controller.B.shape[1], 'measurement')}, "
            f"{_count(len(controller.C), 'command')}, {_type(single)}",
        ),
        (
            "a frame",
            f"{_count(cost.multiplications, 'multiplication')}, "
            f"{_count(cost.additions, 'addition')}",
        ),
    ]
    width = max(len(label) for label, _ in facts)
    listing = "".join(f" *   {label:{width}s}  {text}".rstrip() + "\n" for label, text in facts)
    return f"/* {prefix}: a controller, one frame at a time.\n *\n{listing} *\n" + (
        _NOTES.format(p=prefix) + " */\n"
    )


def _straight_line(prefix: str, controller: Controller, single: bool) -> tuple[str, str]:
    """Write each non-zero term out; factors of 1 and -1 are signs."""
    n, q, m = controller.n_states, controller.B.shape[1], len(controller.C)
    old = [f"x{i}" for i in range(n)] + [f"y{i}" for i in range(q)]
    new = [f"n{i}" for i in range(n)] + [f"y{i}" for i in range(q)]
    entries: list[str] = []
    rows: list[str] = []
    used: set[str] = set()
    for result, names, left, right, matrices in (
        ("n", old, controller.A, controller.B, "AB"),
        ("u", new, controller.C, controller.D, "CD"),
    ):
        for i, row in enumerate(np.hstack([left, right])):
            terms: list[tuple[str, str]] = []
            for j in np.flatnonzero(row):
                value = float(row[j])
                used.add(names[j])
                factor = ""
                if abs(value) != 1:
                    place = f"{matrices[0]}[{i}][{j}]" if j < n else f"{matrices[1]}[{i}][{j - n}]"
                    factor = f"c[{len(entries)}] * "
                    entries.append(f"    {_number(value, single)}, /* {place} = {value!r} */\n")
                terms.append(("-" if value == -1 else "+", factor + names[j]))
            rows.append(_sum(f"{prefix}_real {result}{i}", terms, single))
    loads = [f"    const {prefix}_real x{i} = state->x[{i}];\n" for i in range(n) if old[i] in used]
    loads += [f"    const {prefix}_real y{i} = y[{i}];\n" for i in range(q) if f"y{i}" in used]
    stores = [f"    state->x[{i}] = n{i};\n" for i in range(n)]
    stores += [f"    u[{i}] = u{i};\n" for i in range(m)]
    unread = [] if any(f"y{i}" in used for i in range(q)) else ["    (void)y;\n"]
    table = f"static const {prefix}_real c[{len(entries)}] = {{\n{''.join(entries)}}};\n\n"
    step = "".join([*loads, *rows, "\n", *stores, *unread])
    return (table if entries else ""), step


def _sum(target: str, terms: list[tuple[str, str]], single: bool) -> str:
    """One declaration, its terms wrapped over lines."""
    lines = [f"    const {target} ="]
    for i, (sign, text) in enumerate(terms or [("+", _number(0.0, single))]):
        lead = "" if i == 0 and sign == "+" else ("-" if i == 0 else f"{sign} ")
        if len(lines[-1]) + len(lead) + len(text) + 2 > _WIDTH:
            lines.append("       ")
        lines[-1] += f" {lead}{text}"
    return "\n".join(lines) + ";\n"


def _loops(prefix: str, controller: Controller, single: bool) -> tuple[str, str]:
    """Multiply by whole matrices, stored column by column: compilers vectorise that."""
    P = prefix.upper()
    sizes = {
        "A": (f"{P}_STATES", f"{P}_STATES"),
        "B": (f"{P}_MEASUREMENTS", f"{P}_STATES"),
        "C": (f"{P}_STATES", f"{P}_COMMANDS"),
        "D": (f"{P}_MEASUREMENTS", f"{P}_COMMANDS"),
    }
    table = "/* Matrices by columns: A[j][i] is row i, column j. */\n"
    for name, (columns, rows) in sizes.items():
        table += f"static const {prefix}_real {name}[{columns}][{rows}] = {{\n"
        table += _columns(getattr(controller, name), single) + "};\n\n"
    step = f"""    {prefix}_real next[{P}_STATES];
    {prefix}_real command[{P}_COMMANDS];
    int i, j;

    for (i = 0; i < {P}_STATES; i++) {{
        next[i] = {_number(0.0, single)};
    }}
    for (i = 0; i < {P}_COMMANDS; i++) {{
        command[i] = {_number(0.0, single)};
    }}
"""
    for name, vector, result, length in (
        ("A", "state->x", "next", "STATES"),
        ("B", "y", "next", "MEASUREMENTS"),
        ("C", "next", "command", "STATES"),
        ("D", "y", "command", "MEASUREMENTS"),
    ):
        count = sizes[name][1]
        step += f"""    for (j = 0; j < {P}_{length}; j++) {{
        const {prefix}_real factor = {vector}[j];

        for (i = 0; i < {count}; i++) {{
            {result}[i] += {name}[j][i] * factor;
        }}
    }}
"""
    step += f"""    for (i = 0; i < {P}_STATES; i++) {{
        state->x[i] = next[i];
    }}
    for (i = 0; i < {P}_COMMANDS; i++) {{
        u[i] = command[i];
    }}
"""
    return table, step


def _columns(matrix: FloatArray, single: bool) -> str:
    text = ""
    for j, column in enumerate(matrix.T):
        entries = (
            f"     {_number(float(v), single)}, /* [{i}][{j}] = {float(v)!r} */\n"
            for i, v in enumerate(column)
        )
        text += "    {\n" + "".join(entries) + "    },\n"
    return text


def _type(single: bool) -> str:
    return "float" if single else "double"


def _number(value: float, single: bool) -> str:
    """Exact constant of the type; a value of single precision is already rounded."""
    return (value.hex() if value else "0.0") + ("f" if single else "")


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + ("" if number == 1 else "s")
