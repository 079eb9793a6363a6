"""Coefficients of exported C source, read back from its text as a compiler reads them."""

from __future__ import annotations

import re

import numpy as np

from lbt_synth.validation import FloatArray

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
