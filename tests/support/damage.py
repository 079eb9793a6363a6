"""Damaged files of every format that is read, and what their readers make of them."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import random
import resource
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from support.record_files import image
from support.studies import BASE, TWO, evaluate_quickly, study_file
from support.telemetry import full

import lbt_synth as lbt
from lbt_synth.errors import LbtSynthError
from lbt_synth.studies.study import store

LONGEST_S, MOST_BYTES = 20, 4 * 2**30
TOKENS = [
    *(b"-1", b"0", b"99999999999", b"1e999", b"nan", b"''", b"[[[[", b"{", b"*a", b"<<: *a"),
    *(
        b"\0",
        b"\xff\xff\xff\xff",
        b"\x1b[2J",
        b'"',
        b"\n",
        b"= ",
        b"NAXIS   =            100000000",
    ),
]


def flip_a_bit(content: bytes, draw: random.Random, other: bytes) -> bytes:
    out = bytearray(content)
    out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def flip_many(content: bytes, draw: random.Random, other: bytes) -> bytes:
    for _ in range(draw.randint(2, 40)):
        content = flip_a_bit(content, draw, other)
    return content


def truncate(content: bytes, draw: random.Random, other: bytes) -> bytes:
    return content[: draw.randrange(len(content))]


def splice(content: bytes, draw: random.Random, other: bytes) -> bytes:
    return content[: draw.randrange(len(content))] + other[draw.randrange(len(other)) :]


def repeat(content: bytes, draw: random.Random, other: bytes) -> bytes:
    at = draw.randrange(len(content))
    part = content[at : at + draw.randint(1, 3000)]
    return content[:at] + part * draw.randint(1, 30) + content[at:]


def overwrite(content: bytes, draw: random.Random, other: bytes) -> bytes:
    at, token = draw.randrange(len(content)), draw.choice(TOKENS)
    return content[:at] + token + content[at + len(token) :]


def insert(content: bytes, draw: random.Random, other: bytes) -> bytes:
    at = draw.randrange(len(content))
    return content[:at] + draw.choice(TOKENS) * draw.choice((1, 1, 1, 1000)) + content[at:]


def change_a_number(content: bytes, draw: random.Random, other: bytes) -> bytes:
    digits = [i for i, byte in enumerate(content) if 48 <= byte < 58]
    at = draw.choice(digits or [0])
    return (
        content[:at] + draw.choice((b"0", b"9", b"-", b".", b"e9", b"9" * 300)) + content[at + 1 :]
    )


ATTACKS = (flip_a_bit, flip_many, truncate, splice, repeat, overwrite, insert, change_a_number)


@dataclasses.dataclass(kw_only=True)
class Format:
    """A file, what reads it, and whether a digest or checksum covers what it holds."""

    name: str
    content: bytes
    other: bytes  # of the same format, for splices
    read: Callable[[Path], object]
    path: Path
    covered: bool
    share: int = 10


def fingerprint(value: object) -> str:
    """Return a digest of all that a result holds."""
    total = hashlib.sha256()

    def add(each: object) -> None:
        if isinstance(each, np.ndarray):
            total.update(f"{each.shape}".encode() + np.ascontiguousarray(each).tobytes())
        elif dataclasses.is_dataclass(each):
            for field in dataclasses.fields(each):
                add(getattr(each, field.name, None))
        elif isinstance(each, dict):
            add(sorted(each.items(), key=str))
        elif isinstance(each, list | tuple):
            total.update(b"(")
            for one in each:
                add(one)
        else:
            total.update(repr(each).encode(errors="replace"))

    add(value)
    return total.hexdigest()


def _contents(
    folder: Path, ending: str, save: Callable[[Path, object], object], *objects
) -> list[bytes]:
    out = []
    for number, each in enumerate(objects):
        path = folder / f"seed{number}{ending}"
        save(path, each)
        out.append(path.read_bytes())
    return out


def _record_table(shift: float) -> bytes:
    from astropy.io import fits

    wave = np.sin(np.arange(60.0) + shift)
    columns = [fits.Column(n, "D", "nm", array=wave + i) for i, n in enumerate(("y_tip", "u_tip"))]
    primary = fits.PrimaryHDU()
    primary.header["RATE_HZ"], primary.header["DELAYFRM"] = 500.0, 2.0
    units = [primary, fits.BinTableHDU.from_columns(columns, name="LOOP"), image("OTHER", wave)]
    stream = io.BytesIO()
    fits.HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()


def formats(folder: Path) -> list[Format]:
    """Every format that a command reads, in two variants each."""
    out: list[Format] = []

    def add(name, ending, contents, read, *, covered, share=10):
        path = folder / f"damaged{len(out)}{ending}"
        one, other = contents
        out.append(
            Format(
                name=name,
                content=one,
                other=other,
                read=read,
                path=path,
                covered=covered,
                share=share,
            )
        )

    hardware = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    designs = [lbt.integrator(hardware, gain=gain) for gain in (0.4, 0.5)]
    for ending in (".fits", ".npz"):
        seeds = _contents(folder, ending, lbt.save_gain, *designs)
        add(f"gain file {ending}", ending, seeds, lbt.load_gain, covered=True)
    nights = [full(random=0), full(random=1, frames=8)]
    standard = ((".aot.fits", 2),) if find_spec("aotpy") else ()  # an extra that writes it
    for ending, share in ((".fits", 10), (".npz", 10), *standard):
        seeds = _contents(folder, ending, lbt.files.save_telemetry, *nights)
        add(
            f"telemetry {ending}",
            ending,
            seeds,
            lbt.files.load_telemetry,
            covered=True,
            share=share,
        )
    add(
        "record .fits", ".fits", [_record_table(0), _record_table(1)], lbt.load_record, covered=True
    )
    series = [np.column_stack([np.arange(60.0), np.sin(np.arange(60.0) + i)]) for i in (0, 1)]
    table = [b"# frame_rate_hz = 500\n# delay_frames = 2\ny_nm,u_nm\n"] * 2
    for number, each in enumerate(series):
        stream = io.StringIO()
        np.savetxt(stream, each, delimiter=",")
        table[number] += stream.getvalue().encode()
    add("record .csv", ".csv", table, lbt.load_record, covered=False)
    arrays = _contents(folder, ".npz", lambda p, a: np.savez(p, y=a[:, 0], u=a[:, 1]), *series)
    given = {"frame_rate_hz": 500, "delay_frames": 2, "unit": "nm"}
    read = lambda path: lbt.load_record(path, **given)  # noqa: E731
    add("record .npz", ".npz", arrays, read, covered=False)
    plain = _contents(folder, ".npy", np.save, *(each[:, 1] for each in series))
    read = lambda path: lbt.load_record(path, kind="open_loop", frame_rate_hz=500, unit="nm")  # noqa: E731
    add("record .npy", ".npy", plain, read, covered=False)
    text = [BASE.encode(), BASE.replace("20.0", "&a 30.0").encode()]
    add("configuration", ".yaml", text, lbt.load_config, covered=False, share=3)
    _add_study(folder, add)
    return out


def _add_study(folder: Path, add) -> None:
    source = study_file(folder, samples="60", controllers=TWO)
    study = lbt.studies.load_study(source)
    made = folder / "study"
    made.mkdir()
    (made / "parts").mkdir()
    manifest = [store.new_manifest(study).write(made)] and (made / "study.json").read_bytes()

    def read_manifest(path):
        path.replace(made / "study.json")
        return store.read_manifest(made, study.digest)

    add("study.json", ".json", [manifest, manifest], read_manifest, covered=False)
    parts = [
        store.write_part(made, study, evaluate_quickly(study, study.values(a, b), a), 1.0)
        for a, b in ((0, 20), (20, 40))
    ]

    def read_part(path):
        path.replace(parts[0].path)
        return store.read_part(parts[0], study)

    add("part of a study", ".npz", [p.path.read_bytes() for p in parts], read_part, covered=True)
    failures = [lbt.studies.Failure(row=i, controller="a", error=f"x {i}, y") for i in (3, 4)]
    failed = store.write_failures(made, failures).read_bytes()

    def read_failed(path):
        path.replace(made / "failed.csv")
        return store.read_failures(made)

    add("failed.csv", ".csv", [failed, failed], read_failed, covered=False, share=3)
    lines = source.read_bytes()
    add("study file", ".yaml", [lines, lines], lbt.studies.load_study, covered=False, share=1)


def _read_whole(each: Format, content: bytes) -> str:
    """Return the fingerprint of a file that is not damaged; that of "" where none is read."""
    each.path.write_bytes(content)
    try:
        return fingerprint(each.read(each.path))
    except LbtSynthError:  # the second part of a study is of other rows
        assert content != each.content
        return ""


class _TooLongError(BaseException):
    """Not an Exception, so that no reader takes it for damage."""


def _stop(*_: object) -> None:
    raise _TooLongError


def outcome(each: Format, content: bytes, wholes: set[str]) -> tuple[str, str]:
    """Read damaged content: what came of it, and a traceback where it is one."""
    each.path.write_bytes(content)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        same = fingerprint(each.read(each.path)) in wholes
    except LbtSynthError:
        return "refused", ""
    except _TooLongError:
        return "hangs", traceback.format_exc()
    except BaseException:
        return "tracebacks", traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if same:
        return "the same", ""
    return ("silent changes" if each.covered else "no checksum", "")


def run_trials(folder: Path, trials: int, seed: int = 0, report: Path | None = None) -> Counter:
    """Damage files, and count the outcomes by format and attack."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    before = signal.signal(signal.SIGALRM, _stop)
    draw, counts, began = random.Random(seed), Counter(), time.monotonic()
    try:
        chosen = formats(folder)
        # a splice may be the other file, whole
        wholes = [{_read_whole(each, c) for c in (each.content, each.other)} for each in chosen]
        order = [i for i, each in enumerate(chosen) for _ in range(each.share)]
        for number in range(trials):
            at = draw.choice(order)
            each, attack = chosen[at], draw.choice(ATTACKS)
            content = attack(each.content, draw, each.other)
            found, why = outcome(each, content, wholes[at])
            counts[each.name, attack.__name__, found] += 1
            if report is not None and found in ("hangs", "tracebacks", "silent changes"):
                with report.open("a") as stream:
                    kept = folder / f"finding{seed}_{number}{''.join(each.path.suffixes)}"
                    kept.write_bytes(content)
                    stream.write(f"=== {each.name} {attack.__name__} {found} {kept}\n{why}\n")
    finally:
        signal.signal(signal.SIGALRM, before)
    counts["", "", "seconds"] = round(time.monotonic() - began)
    counts["", "", "peak MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    return counts
