"""Exported C source, compiled by the system's compiler and called through ctypes."""

import ctypes
import itertools
import re
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
_compiled = {}


def compiler(name="cc"):
    found = shutil.which(name)
    assert found, f"these tests need a C compiler; there is no {name} on the path"
    return found


def build(source):
    """Compile a source without a warning and load it; equal sources are compiled once."""
    # a new name each time: a library that is loaded is not loaded again
    target = source.with_name(f"{source.stem}{next(_fresh)}.so")
    key = source.name, source.read_bytes(), source.with_suffix(".h").read_bytes()
    if key not in _compiled:
        command = [compiler(), *STRICT, *PLAIN, "-shared", "-fPIC", source, "-o", target]
        subprocess.run(command, check=True)
        _compiled[key] = target.read_bytes()
    target.write_bytes(_compiled[key])
    return ctypes.CDLL(str(target))


def header_numbers(source, name):
    """Return the whole numbers that a header defines, by name without the prefix."""
    found = re.findall(
        rf"{name.upper()}_(\w+) (?:= )?(\d+)\b", source.with_suffix(".h").read_text()
    )
    return {key: int(value) for key, value in found}


class CompiledFilter:
    """An exported filter of several sensors: its functions, its own state."""

    def __init__(self, source, *, single=False):
        self.name, self.library = source.stem, build(source)
        self.real = np.float32 if single else np.float64
        self.numbers = header_numbers(source, self.name)
        reals = self.numbers["STATES"] + self.numbers["COMMANDS"]
        self.state = np.full(reals * self.real().nbytes + 8, 7, dtype=np.uint8)  # memory as it was
        self.u = np.zeros(self.numbers["COMMANDS"], dtype=self.real)
        self.reset()

    def reset(self):
        getattr(self.library, f"{self.name}_reset")(ctypes.c_void_p(self.state.ctypes.data))

    def phase(self, frames):
        at = ctypes.c_void_p(self.state.ctypes.data)
        getattr(self.library, f"{self.name}_phase")(at, ctypes.c_ulong(frames))

    def step(self, y, fresh, applied):
        """Take readings, what is new of them and applied commands; return the commands."""
        arrays = [np.array(y, dtype=self.real), np.array(fresh, dtype=np.uint8)]
        arrays += [np.array(applied, dtype=self.real), self.u]
        sizes = [self.numbers[key] for key in ("MEASUREMENTS", "SENSORS", "COMMANDS", "COMMANDS")]
        assert [array.size for array in arrays] == sizes
        step = getattr(self.library, f"{self.name}_step")
        self.status = step(*(ctypes.c_void_p(a.ctypes.data) for a in (self.state, *arrays)))
        return self.u.astype(np.float64)


class Compiled:
    """One instance of an exported controller: ``step`` and ``reset``, its own state."""

    def __init__(self, source, *, name=None, single=False, library=None):
        self.name = name or source.stem
        self.real = np.float32 if single else np.float64
        if library is None:
            library = build(source)
        self.library = library
        sizes = header_numbers(source, self.name)
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
