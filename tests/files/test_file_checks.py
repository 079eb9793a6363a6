"""Files of gains and of telemetry: names, foreign content, and damage."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from astropy.io import fits
from support.gain_files import original
from support.refusals import require_refusals
from support.telemetry import full, same

import lbt_synth as lbt
from lbt_synth.errors import FileError, GainFileError, OutputError, TelemetryError
from lbt_synth.storage.array_file import npz_bytes


class Kind(NamedTuple):
    """A kind of file, and what its tests write."""

    make: Callable[[], Any]
    save: Callable[..., Any]
    load: Callable[[Any], Any]
    error: type[FileError]
    is_same: Callable[[Any, Any], bool]


def is_same_design(one, other):
    return np.array_equal(one.controller.A, other.controller.A) and np.array_equal(
        one.gain_predictor, other.gain_predictor
    )


save, load = lbt.files.save_telemetry, lbt.files.load_telemetry
KINDS = {
    "gain": Kind(
        lambda: original("bare"), lbt.save_gain, lbt.load_gain, GainFileError, is_same_design
    ),
    "telemetry": Kind(full, save, load, TelemetryError, same),
}


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.mark.parametrize("ending", ["fits", "npz"])
def test_truncated_files_are_refused_and_flipped_bits_found_or_harmless(tmp_path, kind, ending):
    content = kind.save(tmp_path / f"a.{ending}", kind.make()).read_bytes()
    assert kind.save(tmp_path / f"b.{ending}", kind.make()).read_bytes() == content
    path, size = tmp_path / f"g.{ending}", len(content)
    for length in (0, 10, size // 2, size - 3000, size - 40):
        path.write_bytes(content[: max(length, 0)])
        with pytest.raises(kind.error) as caught:
            kind.load(path)
        assert "\n" not in str(caught.value)
        assert caught.value.path == path
    refused, places = 0, np.linspace(0, size - 1, 31).astype(int)
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 0xFF if place % 2 else 1 << int(place) % 8
        path.write_bytes(bytes(damaged))
        try:
            assert kind.is_same(kind.make(), kind.load(path))
        except kind.error:
            refused += 1
    assert refused > len(places) / 3


def test_foreign_files_are_refused(tmp_path, kind):
    picture, other, pickled = (tmp_path / name for name in ("a.fits", "b.npz", "c.npz"))
    fits.PrimaryHDU(np.ones((4, 4))).writeto(picture)
    np.savez(other, a=np.ones(3))
    np.savez(pickled, META=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    schema = next(name for name, value in KINDS.items() if value is kind)
    head = f'"schema": "lbt_synth {schema} file"'
    for i, text in enumerate(
        (
            '{"schema": "recipes"}',
            "[1, 2]",
            "null",
            "[" * 100_000,
            f'{{{head}, "x": NaN}}',
            f"{{{head}, {head}}}",
            "\x00",
        )
    ):
        (tmp_path / f"hostile{i}.npz").write_bytes(npz_bytes({}, text))
    for stranger in KINDS.values():
        if stranger is not kind:
            stranger.save(tmp_path / "stranger.npz", stranger.make())
    for path in tmp_path.iterdir():
        with pytest.raises(kind.error, match=f"{path.name} is "):
            kind.load(path)


def test_names_that_cannot_be_read_or_written(tmp_path, kind):
    (tmp_path / "folder.fits").mkdir()
    rows = [
        (lambda n=name: kind.load(tmp_path / n), kind.error, words)
        for name, words in (
            ("g.txt", "must end in .fits, .npz.*; got 'g.txt'"),
            ("g.json", "must end in .fits, .npz.*; got 'g.json'"),
            ("none.fits", "cannot read .*No such file"),
            ("folder.fits", "cannot read"),
            ("x\0y.npz", "null"),
        )
    ]
    made = kind.make()
    rows += [
        (lambda n=name: kind.save(tmp_path / n, made), OutputError, words)
        for name, words in (
            ("g.txt", "must end in .fits, .npz.*; got 'g.txt'"),
            ("nowhere/g.fits", "cannot write .*No such file or directory"),
            ("folder.fits", "is a directory"),
            ("x\0y.npz", "null"),
        )
    ]
    require_refusals(rows)
