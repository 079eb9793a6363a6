"""Edits of gain files by a hostile hand, which writes the digest again, and what comes of them."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from support.lqg import shell, slow_plant
from support.plants import LBT_YAML, lbt_axis_plant
from support.shaping import shaped_design

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.files.file_checks import READERS
from lbt_synth.models.sensor_suite import Accelerometer, Motion, SensorSuite, WavefrontSensor
from lbt_synth.storage.array_file import digest, fits_bytes, npz_bytes

ENDINGS = ("fits", "npz")
COMMANDS = ("verify", "show", "simulate", "export")
# What a design does not depend on: words, what its solver said, values of checks (rounding).
NOTES = ("solver", "assumptions", "library_version", "bound_programme", "long_objective_nm")
NOTES += ("long_functions", "value", "computed_by", "CREATOR", "feed_forward", "configuration")


@functools.cache
def odd_plant():
    """A plant whose sensor, mirror, noise and delay are not the simplest."""
    plant = lbt_axis_plant(modes=2)
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=plant.turbulence,
        vibrations=plant.vibrations,
        noise_nm=[15.5, 20.0],
        delay_frames=2.5,
        sensor_matrix=[[1.1, 0.1], [-0.1, 0.9]],
        influence_matrix=[[0.9, 0.0], [0.1, 1.2]],
    )


def bare_problem():
    return lbt.EstimationProblem(
        A=[[1.9, -0.99], [1.0, 0.0]],
        B=[[1.0, 0.0], [0.0, 0.0]],
        C=[[0.0, 1.0]],
        D=[[0.0, 3.0]],
        L=[[1.0, 0.0]],
        dt_s=0.002,
    )


def sensors_original(*, bounded):
    """A filter of a slow sensor and an accelerometer beside the loop's own sensor."""
    slow = WavefrontSensor(name="slow", rate_hz=400, delay_frames=2, noise_nm=9.0)
    shaken = Accelerometer(
        name="mirror",
        rate_hz=800,
        delay_frames=1.5,
        channels=("m1",),
        noise_m_s2=2e-3,
        highpass_hz=1.0,
    )
    own = odd_plant()
    motions = ({"m1": Motion(size=2.0, phase_deg=20.0)},) * len(own.vibrations)
    plant = own.with_sensors(SensorSuite(sensors=(slow, shaken)), motions)
    return lbt.hinf(plant, gamma_ratio=1.2) if bounded else lbt.kalman(plant)


ORIGINALS = {
    "kalman": lambda: lbt.kalman(odd_plant()),
    "bare": lambda: lbt.kalman(bare_problem()),
    "hinf": lambda: lbt.hinf(odd_plant(), gamma_ratio=1.2, route="riccati"),
    "least": lambda: lbt.hinf(lbt_axis_plant(modes=2), gamma_ratio=1, route="riccati"),
    "mixed": lambda: lbt.mixed(lbt_axis_plant(modes=1), gamma_ratio=1.1, taps=4),
    "lqg": lambda: lbt.lqg(slow_plant(2.0, shell(), modes=2), command_weight=0.01),
    "shaped": shaped_design,
    "sensors": lambda: sensors_original(bounded=False),
    "sensors_hinf": lambda: sensors_original(bounded=True),
    "integrator": lambda: lbt.integrator(odd_plant().hardware, gain=0.3),
    "mirror": lambda: lbt.integrator(slow_plant(2.0, shell(), modes=2).hardware, gain=0.1),
}


@functools.cache
def original(name):
    return ORIGINALS[name]()


@dataclass(frozen=True)
class Edit:
    """One change of one field of a gain file."""

    design: str
    ending: str
    place: tuple[Any, ...]  # "arrays", "meta" or "cards", then keys
    change: str
    value: Any

    @property
    def is_note(self):
        return any(key in NOTES for key in self.place)


class GainFile:
    """The content of a gain file, which can be changed and written with a fresh digest."""

    def __init__(self, path):
        self.ending = path.suffix[1:]
        content = path.read_bytes()
        arrays, text = READERS[path.suffix](content)
        self.parts = {"arrays": dict(arrays), "meta": json.loads(text), "cards": {}}
        if self.ending == "fits":
            from astropy.io import fits

            cards = fits.Header.fromfile(io.BytesIO(content)).cards
            skipped = ("SIMPLE", "BITPIX", "NAXIS", "EXTEND", "CHECKSUM", "DATASUM", "SHA256")
            self.parts["cards"] = {c.keyword: c.value for c in cards if c.keyword not in skipped}

    def changed(self, edit):
        other = copy.copy(self)
        other.parts = copy.deepcopy(self.parts)
        *before, last = edit.place
        target = functools.reduce(lambda at, key: at[key], before, other.parts)
        if edit.change == "missing":
            del target[last]
        else:
            target[last] = edit.value
        return other

    def write(self, path):
        """Write the file; what its format cannot hold raises an exception."""
        arrays, meta = self.parts["arrays"], self.parts["meta"]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            meta["digest"] = digest(arrays, meta)
            if self.ending == "npz":
                path.write_bytes(npz_bytes(arrays, json.dumps(meta)))
            else:
                cards = self.parts["cards"] | {"SHA256": meta["digest"]}
                path.write_bytes(fits_bytes(cards, arrays, json.dumps(meta)))
        return path


def leaves(value, place=()):
    """Places of all fields of a tree of dictionaries and lists, branches too."""
    if place:
        yield place
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from leaves(value[key], (*place, key))


def changes(value, rng):
    """Changes of one field: what each is called, and the new value."""
    if isinstance(value, np.ndarray):
        yield from array_changes(value, rng)
        return
    if isinstance(value, bool):
        yield from (("not", not value), ("type", "yes"))
    elif isinstance(value, int | float):
        yield from ((f"times {f}", f * value) for f in (0.8, 1.01, 0.1, -1, 7))
        yield from (("zero", 0.0), ("huge", 1e300), ("one", 1), ("huge", 10**400))
        yield from (("no number", float("nan")), ("no number", float("inf")))
        yield from (("type", str(value)), ("type", True), ("type", [value]), ("type", {}))
    elif isinstance(value, str):
        words = ("kalman", "hinf", "mixed", "integrator", "lqg", "robust", "plant")
        yield from (("word", word) for word in (*words, value + " x", value[:-1], "", "\ud800"))
        yield from (("type", 3), ("type", [value]), ("type", {value: 1}))
    elif isinstance(value, list):
        yield from (("shorter", value[:-1]), ("longer", [*value, 1.0]), ("type", "list"))
        yield from (("longer", [*value, *value]), ("type", dict.fromkeys(map(str, value))))
    elif isinstance(value, dict):
        yield from (("type", list(value)), ("type", "dict"), ("longer", value | {"more": 1}))
    else:
        yield from (("number", 100.0), ("type", "none"), ("type", []))
    yield from (("type", None), ("missing", None))


def array_changes(value, rng):
    yield from ((f"times {f}", f * value) for f in (0.8, 1.01, -1, 7, 0))
    yield from (("transposed", np.ascontiguousarray(value.T)), ("flat", value.ravel()))
    yield from (("deeper", value[None]), ("shorter", value[:-1]), ("narrower", value[:, :-1]))
    yield from (("wider", np.hstack([value, value])), ("longer", np.vstack([value, value])))
    yield from (("type", value.astype(np.complex128) + 1j), ("type", value.astype(str)))
    yield from (("nan", np.where(value == value.flat[0], np.nan, value)), ("missing", None))
    for factor in (0.8, -1, 1.01):
        other = value.copy()
        large = np.flatnonzero(np.abs(value) >= 1e-3 * np.max(np.abs(value)))
        if large.size:
            other.flat[rng.choice(large)] *= factor
            yield f"an entry times {factor}", other
    other = value.copy()
    other.flat[rng.integers(value.size)] += 0.01 * max(float(np.max(np.abs(value))), 1e-9)
    yield "an entry off by a percent", other


def random_edits(count, seed=0, names=None):
    """Edits, with the content of the file that each belongs to: methods and formats in turn."""
    rng = np.random.default_rng(seed)
    names = list(names or ORIGINALS)
    done = 0
    while done < count:
        name, ending = names[done % len(names)], ENDINGS[done // len(names) % len(ENDINGS)]
        parts = saved(name, ending).parts
        part = rng.choice(
            ["arrays", "meta", "meta", "cards"] if ending == "fits" else ["arrays", "meta"]
        )
        places = [p for p in leaves(parts[part], (str(part),)) if len(p) > 1]
        place = places[rng.integers(len(places))]
        value = functools.reduce(lambda at, key: at[key], place, parts)
        options = list(changes(value, rng))
        change, new = options[rng.integers(len(options))]
        edit = Edit(name, ending, place, change, new)
        if place[-1] != "digest" and not same(value, new):
            yield edit
            done += 1


@functools.cache
def saved(name, ending):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        return GainFile(lbt.save_gain(Path(folder) / f"g.{ending}", original(name)))


def same(one, other):
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.shape == other.shape and one.dtype == other.dtype and np.array_equal(one, other)
    return type(one) is type(other) and not isinstance(one, np.ndarray) and one == other


def command(name, path):
    """Arguments of a command on a gain file."""
    options = {
        "verify": [path],
        "show": [path, "--matrices", "--json"],
        "simulate": [LBT_YAML, path, "--frames", "8", "--cases", "1"],
        "export": [path, "--for", "c", "-o", path.with_name("k.c")],
    }
    return [name, *map(str, options[name])]


def run_quietly(arguments):
    """Exit status, what was printed, and errors; an exception that escapes is a traceback."""
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        status = main(arguments)
    return status, out.getvalue(), error.getvalue()


def facts(shown):
    """What ``show`` says of a design but for notes, as numbers and words."""
    found = {}

    def walk(value, place):
        if isinstance(value, dict | list):
            items = value.items() if isinstance(value, dict) else enumerate(value)
            for key, each in items:
                walk(each, (*place, key))
        elif not any(key in (*NOTES, "file", "route", "passed", "digest") for key in place):
            found[place] = value

    walk(json.loads(shown), ())
    return found


@functools.cache
def facts_of_original(name):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = lbt.save_gain(Path(folder) / "g.npz", original(name))
        return facts(run_quietly(command("show", path))[1])


def differ(one, other):
    if isinstance(one, float) and isinstance(other, float):
        return not np.isclose(one, other, rtol=1e-5, atol=1e-9, equal_nan=True)
    return one != other


def judge(edit, folder, commands=COMMANDS):
    """What comes of an edit: one of "refused", "no other design", "another claim that holds",
    "certified" or "traceback".

    Where one of the commands takes the file, the others are asked, too.

    "certified" is a file that a command takes, although it says another design of the same
    fields; "no other design" one whose controller, claims and matrices are those of the original.
    "another claim that holds" is the same controller with another band or term of its objective:
    all that ``show`` says else is the same, and what is claimed was computed again and reached.
    """
    path = folder / f"edited.{edit.ending}"
    try:
        saved(edit.design, edit.ending).changed(edit).write(path)
    except Exception:  # the format cannot hold it: no such file
        return "cannot be written"
    taken, found = [], {}
    for name in (*commands, *(c for c in COMMANDS if c not in commands)):
        if name not in commands and not taken:
            break  # refused by those that were asked: the others read it the same way
        try:
            status, shown, error = run_quietly(command(name, path))
        except Exception as escaped:
            return f"traceback of {type(escaped).__name__} in {name}: {escaped}"
        if status and len(error.strip().splitlines()) > 1:
            return f"more than a line in {name}: {error}"
        taken += [name] if status == 0 else []
        if name == "show" and status == 0:
            found = facts(shown)
    if not taken:
        return "refused"
    own = facts_of_original(edit.design)
    changed = {k[0] for k in own.keys() | found.keys() if differ(own.get(k), found.get(k))}
    if not changed:
        return "no other design"
    promise = edit.place[:2] == ("meta", "specifications")
    if promise and found and changed <= {"terms", "limit_nm", "above_limit_percent"}:
        return "another claim that holds"
    return f"certified by {', '.join(taken)}"
