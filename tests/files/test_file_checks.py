"""Files of gains and of telemetry: names, foreign content, and damage."""

from collections import namedtuple
from functools import partial
from operator import attrgetter

import numpy as np
import pytest
from astropy.io import fits
from support.gain_files import original
from support.refusals import refused
from support.telemetry import full, same

import lbt_synth as lbt
from lbt_synth.errors import GainFileError, OutputError, TelemetryError
from lbt_synth.storage.array_file import npz_bytes


def same_filter(one, other):
    arrays = attrgetter("controller.A"), attrgetter("gain_predictor")
    return all(np.array_equal(get(one), get(other)) for get in arrays)


Kind = namedtuple("Kind", "make save load error is_same")
make = partial(original, "bare")
save, load = lbt.files.save_telemetry, lbt.files.load_telemetry
KINDS = {
    "gain": Kind(make, lbt.save_gain, lbt.load_gain, GainFileError, same_filter),
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
        error = refused(lambda: kind.load(path), kind.error, None)
        assert ("\n" in str(error), error.path) == (False, path)
    found, places = 0, np.linspace(0, size - 1, 31).astype(int)
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 0xFF if place % 2 else 1 << int(place) % 8
        path.write_bytes(bytes(damaged))
        try:
            assert kind.is_same(kind.make(), kind.load(path))
        except kind.error:
            found += 1
    assert found > len(places) / 3


def test_foreign_files_are_refused(tmp_path, kind):
    picture, other, pickled = (tmp_path / name for name in ("a.fits", "b.npz", "c.npz"))
    fits.PrimaryHDU(np.ones((4, 4))).writeto(picture)
    np.savez(other, a=np.ones(3))
    np.savez(pickled, META=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    schema = next(name for name, value in KINDS.items() if value is kind)
    head = f'"schema": "lbt_synth {schema} file"'
    texts = ('{"schema": "recipes"}', "[1, 2]", "null", "[" * 100_000, "\x00")
    for i, text in enumerate((*texts, f'{{{head}, "x": NaN}}', f"{{{head}, {head}}}")):
        (tmp_path / f"hostile{i}.npz").write_bytes(npz_bytes({}, text))
    for stranger in KINDS.values():
        if stranger is not kind:
            stranger.save(tmp_path / "stranger.npz", stranger.make())
    for path in tmp_path.iterdir():
        refused(partial(kind.load, path), kind.error, f"{path.name} is ")


def test_names_that_cannot_be_read_or_written(tmp_path, kind):
    (tmp_path / "folder.fits").mkdir()
    endings = [(name, f"must end in .fits, .npz.*; got '{name}'") for name in ("g.txt", "g.json")]
    unread = ("none.fits", "No such file"), ("folder.fits", "cannot read"), ("x\0y.npz", "null")
    for name, words in (*endings, *unread):
        refused(partial(kind.load, tmp_path / name), kind.error, words)
    missing = "cannot write .*No such file or directory"
    unwritten = ("nowhere/g.fits", missing), ("folder.fits", "is a dir"), ("x\0y.npz", "null")
    for name, words in (endings[0], *unwritten):
        refused(partial(kind.save, tmp_path / name, kind.make()), OutputError, words)
