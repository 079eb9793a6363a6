"""Exported C source, compiled by the system's compiler and called through ctypes."""

from __future__ import annotations

import ctypes
import itertools
import shutil
import subprocess

import numpy as np

STRICT = [
    "-std=c99",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-Wdouble-promotion",
    "-Wconversion",
]
PLAIN = ["-O2", "-ffp-contract=off"]  # each product and each sum is rounded
_fresh = itertools.count()


def compiler(name="cc"):
    found = shutil.which(name)
    assert found, f"these tests need a C compiler; there is no {name} on the path"
    return found


class Compiled:
    """One instance of an exported controller: ``step`` and ``reset``, its own state."""

    def __init__(self, source, *, name=None, single=False, library=None):
        self.name = name or source.stem
        self.real = np.float32 if single else np.float64
        if library is None:
            # a new name each time: a library that is loaded is not loaded again
            target = source.with_name(f"{source.stem}{next(_fresh)}.so")
            subprocess.run(
                [compiler(), *STRICT, *PLAIN, "-shared", "-fPIC", source, "-o", target], check=True
            )
            library = ctypes.CDLL(str(target))
        self.library = library
        text = source.with_suffix(".h").read_text()
        sizes = {
            key: int(text.split(f"{self.name.upper()}_{key} ")[1].split()[0])
            for key in ("STATES", "MEASUREMENTS", "COMMANDS")
        }
        size = sizes["STATES"] + sizes["COMMANDS"]
        self.state = np.full(size, 7.0, dtype=self.real)  # what was in the memory before
        self.inputs = sizes["MEASUREMENTS"]
        self.u = np.zeros(sizes["COMMANDS"], dtype=self.real)
        self.reset()

    def _call(self, function, *arrays):
        call = getattr(self.library, f"{self.name}_{function}")
        call.restype = ctypes.c_int if function == "step" else None
        return call(*(ctypes.c_void_p(a.ctypes.data) for a in arrays))

    def reset(self):
        self._call("reset", self.state)

    def step(self, y, *applied):
        """The estimator form is given the applied commands, too."""
        measured = np.array(y, dtype=self.real)
        assert measured.shape == (self.inputs,)
        given = [np.array(values, dtype=self.real) for values in applied]
        self.held = self._call("step", self.state, measured, *given, self.u)
        return self.u.astype(np.float64)
