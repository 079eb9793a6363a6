"""Gain files: round trips, damage, tampering, hostile files."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.gain_files import DESIGNS, ENDINGS

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", DESIGNS)
def test_round_trip_keeps_every_bit(tmp_path, name, ending):
    design = DESIGNS[name]
    back = lbt.load_gain(lbt.save_gain(tmp_path / f"gain.{ending}", design))
    assert type(back) is type(design)
    for field in "ABCD":
        assert np.array_equal(getattr(back.controller, field), getattr(design.controller, field))
    assert back.controller.dt_s == design.controller.dt_s
    assert back.solver == design.solver
    assert back.certificate.checks == design.certificate.checks
    assert back.recertify().passed
    if isinstance(design, lbt.design.FilterDesign):
        assert type(back.problem) is type(design.problem)
        for field in ("gain_predictor", "gain_filter"):
            assert np.array_equal(getattr(back, field), getattr(design, field))
        for field in "ABCDL":
            assert np.array_equal(getattr(back.problem, field), getattr(design.problem, field))
        assert (back.gamma_requested, back.gamma_least) == (
            design.gamma_requested,
            design.gamma_least,
        )
        assert (back.rms, back.gamma) == (design.rms, design.gamma)
    else:
        assert back.gain == design.gain
    if design.hardware is not None:
        assert back.hardware.delay_frames == design.hardware.delay_frames
        assert np.array_equal(back.hardware.sensor, design.hardware.sensor)


def test_vibrations_survive(tmp_path):
    back = lbt.load_gain(lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"]))
    assert back.problem.vibrations == DESIGNS["kalman"].problem.vibrations


@pytest.mark.parametrize("ending", ENDINGS)
def test_truncated_files_are_refused(tmp_path, ending):
    path = lbt.save_gain(tmp_path / f"g.{ending}", DESIGNS["hinf"])
    content = path.read_bytes()
    for length in (
        0,
        10,
        len(content) // 3,
        len(content) // 2,
        len(content) - 3000,
        len(content) - 40,
    ):
        path.write_bytes(content[:length])
        with pytest.raises(lbt.errors.GainFileError) as caught:
            lbt.load_gain(path)
        assert "\n" not in str(caught.value)


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    ending=st.sampled_from(ENDINGS), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7)
)
def test_a_flipped_bit_is_found_or_harmless(tmp_path, ending, place, bit):
    path = lbt.save_gain(tmp_path / f"g.{ending}", DESIGNS["kalman"])
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    path.write_bytes(bytes(content))
    try:
        back = lbt.load_gain(path)
    except lbt.errors.GainFileError:
        return
    assert np.array_equal(back.controller.A, DESIGNS["kalman"].controller.A)
    assert np.array_equal(back.gain_predictor, DESIGNS["kalman"].gain_predictor)


def test_foreign_files_are_refused(tmp_path):
    picture = tmp_path / "image.fits"
    fits.PrimaryHDU(np.ones((4, 4))).writeto(picture)
    other = tmp_path / "other.npz"
    np.savez(other, a=np.ones(3))
    notes = tmp_path / "notes.json"
    notes.write_text('{"meta": {"schema": "recipes"}, "arrays": {}}')
    prose = tmp_path / "prose.json"
    prose.write_text("[1, 2]")
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, META=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for path in (picture, other, notes, prose, pickled):
        with pytest.raises(lbt.errors.GainFileError, match=f"{path.name} is "):
            lbt.load_gain(path)


def edited(tmp_path, change, *, resign=True):
    path = lbt.save_gain(tmp_path / "g.json", DESIGNS["kalman"])
    document = json.loads(path.read_text())
    change(document)
    if resign:
        arrays = {k: np.array(v, dtype=float) for k, v in document["arrays"].items()}
        document["meta"]["digest"] = digest(arrays, document["meta"])
    path.write_text(json.dumps(document))
    return path


def test_an_edited_gain_does_not_match_its_digest(tmp_path):
    def change(document):
        document["arrays"]["GAIN_PREDICTOR"][0][0] *= 1.0001

    with pytest.raises(lbt.errors.GainFileError, match="does not match its digest"):
        lbt.load_gain(edited(tmp_path, change, resign=False))


def test_a_later_layout_is_refused_by_its_number(tmp_path):
    with pytest.raises(
        lbt.errors.SchemaVersionError, match="layout version 99; this lbt_synth reads 1"
    ):
        lbt.load_gain(edited(tmp_path, lambda d: d["meta"].update(schema_version=99)))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda d: d["arrays"].pop("A"), "A is missing"),
        (lambda d: d["arrays"].update(B=[[1.0]]), "B must have"),
        (lambda d: d["arrays"].update(GAIN_FILTER=[[1.0]]), "GAIN_FILTER must be"),
        (lambda d: d["arrays"].update(A=[[float("nan")]]), "holds values that are not finite"),
        (lambda d: d["meta"].pop("certificate"), "certificate is missing"),
        (lambda d: d["meta"].update(problem="riddle"), "riddle"),
        (lambda d: d["meta"].update(delay_frames=-1), "delay_frames must be"),
    ],
)
def test_signed_nonsense_is_inconsistent(tmp_path, change, text):
    with pytest.raises(lbt.errors.GainFileError, match=text):
        lbt.load_gain(edited(tmp_path, change))


def test_a_file_that_was_tampered_with_is_not_verified(tmp_path):
    """Even when it is signed anew: verification computes everything from the matrices."""

    def change(document):
        gain = document["arrays"]["GAIN_PREDICTOR"]
        gain[0][0] *= 1.01

    assert not lbt.load_gain(edited(tmp_path, change)).recertify().passed


def test_endings_and_missing_files(tmp_path):
    with pytest.raises(lbt.errors.OutputError, match="must end in .fits, .npz, .json; got 'g.txt'"):
        lbt.save_gain(tmp_path / "g.txt", DESIGNS["kalman"])
    with pytest.raises(lbt.errors.GainFileError, match="must end in"):
        lbt.load_gain(tmp_path / "g.txt")
    with pytest.raises(lbt.errors.GainFileError, match="cannot read .*No such file"):
        lbt.load_gain(tmp_path / "none.fits")
    (tmp_path / "folder.fits").mkdir()
    with pytest.raises(lbt.errors.GainFileError, match="cannot read"):
        lbt.load_gain(tmp_path / "folder.fits")


def test_nothing_half_written_stays(tmp_path, monkeypatch):
    path = lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"])
    before = path.read_bytes()

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(lbt.errors.OutputError, match="cannot write .*No space left on device"):
        lbt.save_gain(path, DESIGNS["hinf"])
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["g.fits"]


def test_directories_that_cannot_be_written(tmp_path):
    with pytest.raises(lbt.errors.OutputError, match="cannot write .*No such file or directory"):
        lbt.save_gain(tmp_path / "nowhere" / "g.fits", DESIGNS["kalman"])
    (tmp_path / "taken.fits").mkdir()
    with pytest.raises(lbt.errors.OutputError, match="is a directory"):
        lbt.save_gain(tmp_path / "taken.fits", DESIGNS["kalman"])
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(lbt.errors.OutputError, match="Not a directory"):
        lbt.save_gain(file / "g.fits", DESIGNS["kalman"])


@pytest.mark.parametrize(
    "text",
    [
        '{"meta": {}, "arrays": []}',
        '{"meta": null, "arrays": {}}',
        "[" * 100_000,
        '{"meta": {"schema": "lbt_synth gain file", "x": NaN}, "arrays": {}}',
        '{"meta": {}, "arrays": {"A": [[1' + "0" * 400 + "]]}}",
        '{"meta": {}, "arrays": {"\\ud800": [[1]]}}',
        "\x00",
    ],
)
def test_hostile_json(tmp_path, text):
    path = tmp_path / "h.json"
    path.write_text(text)
    with pytest.raises(lbt.errors.GainFileError):
        lbt.load_gain(path)


def test_hostile_archives(tmp_path):
    content = lbt.save_gain(tmp_path / "g.npz", DESIGNS["bare"]).read_bytes()
    path = tmp_path / "h.npz"
    for place in range(0, len(content), 7):  # every kind of byte of the format, one at a time
        damaged = bytearray(content)
        damaged[place] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            assert np.array_equal(lbt.load_gain(path).controller.A, DESIGNS["bare"].controller.A)
        except lbt.errors.GainFileError:
            continue


def test_impossible_names():
    with pytest.raises(lbt.errors.GainFileError, match="null"):
        lbt.load_gain("x\0y.json")
    with pytest.raises(lbt.errors.OutputError, match="null"):
        lbt.save_gain("x\0y.json", DESIGNS["bare"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_design_is_the_same_file(tmp_path, ending):
    one = lbt.save_gain(tmp_path / f"a.{ending}", DESIGNS["kalman"]).read_bytes()
    assert lbt.save_gain(tmp_path / f"b.{ending}", DESIGNS["kalman"]).read_bytes() == one


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"RATE_HZ =                800.0", b"RATE_HZ =                900.0"),
        (b"VERSION =                    1", b"VERSION =                    2"),
        (b"NEWSTATE=                    T", b"NEWSTATE=                    F"),
    ],
)
def test_an_edited_header_card_is_found(tmp_path, old, new):
    path = lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"])
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    with pytest.raises(lbt.errors.GainFileError, match="a checksum is broken"):
        lbt.load_gain(path)


def test_only_designs_are_saved(tmp_path):
    with pytest.raises(lbt.errors.OutputError, match="holds a Design; got int"):
        lbt.save_gain(tmp_path / "g.fits", 3)
