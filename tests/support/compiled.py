"""Exported C source, compiled by the system's compiler and called through ctypes."""

import ctypes
import itertools
import re
import shutil
import subprocess

import numpy as np

STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion"]
STRICT += ["-Wconversion"]
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


class Compiled:
    """One instance of an exported controller: its functions, its own state."""

    def __init__(self, source, *, name=None, single=False):
        self.name = name or source.stem
        self.real = np.float32 if single else np.float64
        self.library = build(source)
        header = source.with_suffix(".h").read_text()
        numbers = re.findall(rf"{self.name.upper()}_(\w+) (?:= )?(\d+)\b", header)
        self.numbers = {key: int(value) for key, value in numbers}
        size = self.numbers["STATES"] + self.numbers["COMMANDS"]
        self.masked = "SENSORS" in self.numbers
        self.estimator = "*applied" in header
        if self.masked:  # a flag and a phase
            size += 8 // self.real().nbytes
        self.state = np.full(size, 7.0, dtype=self.real)  # what was in the memory before
        self.u = np.zeros(self.numbers["COMMANDS"], dtype=self.real)
        self.reset()

    def _call(self, function, *arrays):
        call = getattr(self.library, f"{self.name}_{function}")
        call.restype = ctypes.c_int if function == "step" else None
        return call(*(ctypes.c_void_p(a.ctypes.data) for a in arrays))

    def reset(self):
        self._call("reset", self.state)

    def phase(self, frames):
        at = ctypes.c_void_p(self.state.ctypes.data)
        getattr(self.library, f"{self.name}_phase")(at, ctypes.c_ulong(frames))

    def step(self, y, *given):
        """Take measurements, what is new and applied commands (its own); return the commands."""
        given = given or ([self.u] if self.estimator else [])
        arrays = [np.array(y, dtype=self.real)]
        assert arrays[0].shape == (self.numbers["MEASUREMENTS"],)
        kinds = [np.uint8] * self.masked + [self.real]
        arrays += [np.array(values, dtype=kind) for values, kind in zip(given, kinds, strict=False)]
        assert not self.masked or arrays[1].size == self.numbers["SENSORS"]
        self.status = self._call("step", self.state, *arrays, self.u)
        return self.u.astype(np.float64)
