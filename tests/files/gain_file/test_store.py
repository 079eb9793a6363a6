"""Gain files: round trips, damage, tampering, hostile files."""

import copy
import functools
import json
import operator
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import cycle

import numpy as np
import pytest
from astropy.io import fits
from support.exports import relative
from support.gain_files import ORIGINALS, edited_file, original
from support.plants import LBT_YAML, ROOT
from support.refusals import refused
from support.specula_filters import noise_series, simulate_commands

import lbt_synth as lbt
from lbt_synth.design.loop_shaping import ShapedDesign
from lbt_synth.design.record import record_design
from lbt_synth.errors import GainFileError, OutputError, ProblemError, SchemaVersionError
from lbt_synth.files.gain_file import store
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz

ENDINGS = ("fits", "npz")


def state_space_filter(path, inputs):
    """Yield the outputs of a FITS file, read as SPECULA's state-space filter does, new state first."""
    with fits.open(path) as hdus:
        header = hdus[0].header
        assert (header.get("VERSION", 1), hdus[0].data) == (1, None)
        A, B, C, D = (hdus[name].data.copy() for name in "ABCD")
    n, q = header["NSTATES"], header["NFILTER"]
    assert [X.shape for X in (A, B, C, D)] == [(n, n), (n, q), (q, n), (q, q)]
    x = np.zeros(n)
    for u in inputs:
        x = A @ x + B @ u
        yield C @ x + D @ u


def test_records_agree_to_the_last_digits():
    """To 1e-9 of an entry; what is further apart is named, with its part of the largest entry."""
    record = record_design(original("kalman"))
    B = record.arrays["B"]

    def compare(part):
        moved = np.where(np.abs(B) == np.max(np.abs(B)), (1 + part) * B, B)
        store.require_agreement(replace(record, arrays=record.arrays | {"B": moved}), record)

    compare(0.9e-9)
    words = "B is not what .*differs by 1.1e-09 of the largest"
    refused(lambda: compare(1.1e-9), ValueError, words)
    refused(lambda: compare(0.25), ValueError, "by 0.2 of the largest")  # 1.25 is the largest


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "sensors"])
def test_a_fits_file_speaks_to_people_and_drives_a_foreign_filter(tmp_path, name):
    design = replace(original(name), diameter_m=8.22, shown_unit="mas")
    path = lbt.save_gain(tmp_path / "g.fits", design)
    loaded = lbt.load_gain(path)
    assert (loaded.diameter_m, loaded.shown_unit) == (8.22, "mas")
    header, inputs = fits.getheader(path), design.controller.B.shape[-1]
    expected = {"METHOD": design.method, "RATE_HZ": 800, "DELAY": 2.5, "NEWSTATE": True}
    expected |= {} if name == "integrator" else {"RMS": pytest.approx(design.rms)}
    expected |= {"NFILTER": inputs, "DIAMETER": 8.22, "SHOWUNIT": "mas"}
    assert {key: header[key] for key in expected} == expected
    if name == "sensors":  # its matrices change from frame to frame
        return
    series, run = np.random.default_rng(0).standard_normal((100, 2)), design.controller.start()
    commands = np.array([run.step(y) for y in series])
    outputs = np.array([*state_space_filter(path, series)])
    assert np.allclose(outputs, commands, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("name", "ending"), [*zip(ORIGINALS, cycle(ENDINGS), strict=False)])
def test_round_trip_keeps_every_bit(tmp_path, name, ending):
    design = original(name)
    back = lbt.load_gain(lbt.save_gain(tmp_path / f"gain.{ending}", design))
    assert type(back) is type(design)
    assert type(back.problem) is type(design.problem)
    one, other = record_design(design), record_design(back)  # of controller, claims, solver, checks
    assert one.arrays.keys() == other.arrays.keys()
    assert all(np.array_equal(array, other.arrays[key]) for key, array in one.arrays.items())
    assert json.dumps(one.meta) == json.dumps(other.meta)
    assert back.recertify().passed
    if isinstance(design, ShapedDesign):
        assert back.terms_nm() == design.terms_nm()
    if design.hardware is not None:
        assert back.hardware.suite.is_same(design.hardware.suite)
        assert np.array_equal(back.hardware.mirror_taps, design.hardware.mirror_taps)


def scale_gain(document):
    document["arrays"]["GAIN_PREDICTOR"][0][0] *= 1.01


def changed(*keys, **changes):
    def change(document):
        functools.reduce(lambda branch, key: branch[key], keys, document).update(changes)

    return change


def double_demands(document):
    document["meta"]["specifications"][0]["demands"] *= 2


META, CLAIMS = ("meta",), ("meta", "claims")
SHAPE = ("meta", "specifications", 0)
BAND = (*SHAPE, "terms", 1)
AGAIN = "Design it again with lbt-synth design CONFIG --method METHOD -o FILE."
LAYOUT = f"layout version 99, of lbt_synth 0.2.0; this version reads 5. {AGAIN}"
SPECIFICATION = "expected a Specification"
MARGIN = {"kind": "Bound", "response": "rejection", "at_most": 2.0}


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("kalman", scale_gain, "A is not what plant, loop and gains make"),
        ("kalman", lambda d: d["arrays"].pop("A"), "A is missing"),
        ("kalman", changed("arrays", B=[[1.0]]), "B must be"),
        ("kalman", changed("arrays", GAIN_PREDICTOR=[[1.0]]), "gain_predictor must"),
        ("kalman", changed("arrays", A=[[float("nan")]]), "A must be finite"),
        ("kalman", lambda d: d["meta"].pop("certificate"), "certificate is missing"),
        ("kalman", changed(*META, problem="riddle"), "riddle"),
        ("kalman", changed(*META, delay_frames=-1), "delay_frames must be"),
        ("lqg", lambda d: d["arrays"]["GAIN_MIRROR"].pop(), "gain_mirror must be"),
        ("kalman", changed(*META, schema_version=99, library_version="0.2.0"), LAYOUT),
        ("kalman", changed(*META, schema_version=1), "layout version 1, of"),
        ("shaped", changed(*CLAIMS, objective_nm=[-1.0]), "must be at least 0"),
        ("shaped", changed(*CLAIMS, beauty=1.0), "does not claim beauty"),
        ("shaped", changed(*META, long_objective_nm=["inf"]), "long_objective_nm must be a number"),
        ("shaped", changed(*CLAIMS, objective_nm=[30.0, 30.0]), "one for each mode"),
        ("shaped", changed(*META, specifications=[MARGIN]), SPECIFICATION),
        ("shaped", changed(*META, specifications=[3]), SPECIFICATION),
        ("shaped", changed(*BAND, high_hz=900.0), "below the Nyquist"),
        ("shaped", changed(*SHAPE, kind="Anything"), "Anything"),
        ("shaped", changed(*BAND, high_hz=12.0), ""),  # it leaves more there
        ("shaped", double_demands, ""),
    ],
)
def test_files_that_were_edited_and_signed_anew_are_refused(tmp_path, name, change, text):
    error = SchemaVersionError if "layout" in text else GainFileError
    path = edited_file(tmp_path / "g.npz", original(name), change)
    refused(lambda: lbt.load_gain(path), error, text or None)


def test_a_file_that_was_edited_and_not_signed_does_not_match_its_digest(tmp_path):
    files = [tmp_path / name for name in ("g.npz", "card.fits", "header.fits")]
    edited_file(files[0], original("kalman"), scale_gain, digest_again=False)
    for path in files[1:]:
        lbt.save_gain(path, original("kalman"))
    card, content = b"RATE_HZ =                800.0", files[1].read_bytes()
    assert card in content
    files[1].write_bytes(content.replace(card, card.replace(b"8", b"9")))
    with fits.open(files[2], "update", checksum=True) as hdus:  # behind a right checksum
        hdus[0].header["RATE_HZ"] = 900.0
    wrong = "the checksum of its HDU 0 is wrong", "header.RATE_HZ must be 800.0"
    for path, words in zip(files, ("does not match its digest", *wrong), strict=True):
        refused(partial(lbt.load_gain, path), GainFileError, words)


def test_only_designs_are_saved(tmp_path):
    path, twisted = tmp_path / "g.fits", replace(original("kalman"))
    k = twisted.controller
    object.__setattr__(twisted, "controller", replace(k, B=1.001 * k.B))
    refused(lambda: lbt.save_gain(path, 3), ProblemError, "design must be a Design; got int")
    refused(lambda: lbt.save_gain(twisted, path), ProblemError, "path of a file; got FilterDesign")
    words = "contradicts itself: B is not what plant"
    refused(lambda: lbt.save_gain(path, twisted), OutputError, words)
    assert not path.exists()


SCRIPT = ROOT / "tests" / "support" / "specula_filters.py"
NAMES = ["kalman", "hinf", "integrator"]
LIMITS = (1e-12, 1e-5)  # in double and in single precision


@pytest.fixture(scope="module", params=[0, 1], ids=["double", "single"])
def specula_run(request, lbt_designs, tmp_path_factory):
    """Commands of each gain file in SPECULA, in the closed loop and on given measurements."""
    folder = tmp_path_factory.mktemp("specula")
    output = folder / "commands.npz"
    files = [lbt.save_gain(folder / f"{name}.fits", lbt_designs[name]) for name in NAMES]
    call = [sys.executable, SCRIPT, str(request.param), output, LBT_YAML, *files]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(output) as data:
        series = {name: (data[f"loop{i}"], data[f"noise{i}"]) for i, name in enumerate(NAMES)}
    return request.param, series


@pytest.mark.e2e
@pytest.mark.parametrize("name", NAMES)
def test_specula_commands_what_our_simulator_does(lbt_designs, specula_run, name):
    """Its filter in the loop, and on measurements of no loop, with the gain file untouched."""
    precision, series = specula_run
    controller = lbt_designs[name].controller
    looped, run = simulate_commands(controller, LBT_YAML), controller.start()
    assert np.max(np.abs(looped)) > 100  # nm: there is something to correct
    assert relative(series[name][0], looped) < LIMITS[precision]
    stepped = np.array([run.step(y) for y in noise_series(2)])
    assert relative(series[name][1], stepped) < LIMITS[precision]


# What a design does not depend on: words, what its solver said, values of checks (rounding).
NOTES = {"solver", "assumptions", "library_version", "bound_programme", "long_objective_nm"}
NOTES |= {"value", "computed_by", "configuration"}
MISSING = object()


def fields(value, place=()):
    """Yield places and values of all fields of a tree of dictionaries and lists, branches too."""
    if place:
        yield place, value
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from fields(value[key], (*place, key))


def replacements(value):
    """Return what a hostile hand may write in place of a field."""
    other, same = [100.0, "none", []], operator.eq
    match value:
        case np.ndarray():
            other, same = [value.copy(), 0.8 * value, value[:-1], value[None]], np.array_equal
            other[0].flat[np.argmax(np.abs(value))] *= 1.01
            other.append(np.full_like(value, np.nan))
        case bool():
            other = [not value, "yes"]
        case int() | float():
            other = [1.01 * value, 7 * value, -value, 0.0, 1e300, float("nan"), str(value), [value]]
        case str():
            other = ["kalman", "hinf", "integrator", "lqg", "plant", value + " x", "", "\ud800", 3]
        case list():
            other = [value[:-1], [*value, 1.0], [*value, *value], "list"]
        case dict():
            other = [list(value), value | {"more": 1}, "dict"]
    other += [None, MISSING]
    return [new for new in other if type(new) is not type(value) or not same(new, value)]


def without_notes(value):
    if isinstance(value, dict):
        return {key: without_notes(each) for key, each in value.items() if key not in NOTES}
    return [without_notes(each) for each in value] if isinstance(value, list | tuple) else value


def outcome(name, parts, place, new, path):
    """Say what comes of a file of which one field was changed and the digest written again."""
    document = copy.deepcopy(parts)
    *before, last = place
    branch = functools.reduce(lambda at, key: at[key], before, document)
    branch[last] = new
    if new is MISSING:
        del branch[last]
    try:
        document["meta"]["digest"] = digest(document["arrays"], document["meta"])
        path.write_bytes(npz_bytes(document["arrays"], json.dumps(document["meta"])))
    except (TypeError, ValueError, AttributeError):
        return "cannot be written"
    try:
        back = lbt.load_gain(path)
    except GainFileError as error:
        return "refused" if "\n" not in str(error) else "refused in many lines"
    if not back.recertify().passed:
        return "refused"
    one, other = record_design(original(name)), record_design(back)
    equal = one.arrays.keys() == other.arrays.keys() and all(
        np.shape(array) == np.shape(other.arrays[key])
        and np.allclose(other.arrays[key], array, rtol=1e-12, atol=0)
        for key, array in one.arrays.items()
    )
    if not equal or one.meta["claims"] != other.meta["claims"]:
        return "another design"
    same = without_notes(one.meta) == without_notes(other.meta)
    return "the same design" if same else f"another word: {last}"


def outcomes(name, count, folder):
    """Count what comes of some of all changes of one field of the file of a design."""
    arrays, text = read_npz(lbt.save_gain(folder / "g.npz", original(name)).read_bytes())
    parts = {"arrays": dict(arrays), "meta": json.loads(text)}
    edits = [
        (place, new)
        for place, value in fields(parts)
        if len(place) > 1 and place[-1] != "digest"
        for new in replacements(value)
    ]
    chosen = np.random.default_rng(1).permutation(len(edits))[:count]
    return Counter(outcome(name, parts, *edits[i], folder / "g.npz") for i in chosen)


# Nothing proves the period of a problem without a loop, names, and a calibrated feed-forward; and
# an objective that was computed again holds.
WORDS = ("dt_s", "name", "method", "feed_forward", "low_hz", "high_hz", "rms_nm")
WORDS = {f"another word: {key}" for key in WORDS}
HARMLESS = {"refused", "the same design", "cannot be written"}


@pytest.mark.parametrize("name", ["kalman", "bare", "integrator"])
def test_no_edit_of_some_is_taken_for_another_design(tmp_path, name):
    counts = outcomes(name, 30, tmp_path)
    assert counts.keys() <= HARMLESS | WORDS
    assert counts["refused"] > 15


@pytest.mark.study
@pytest.mark.parametrize("name", ORIGINALS)
def test_no_edit_is_taken_for_another_design(tmp_path, name, capsys):
    counts = outcomes(name, 180, tmp_path)
    with capsys.disabled():
        row = [counts[kind] for kind in ("refused", "the same design", "cannot be written")]
        print("|", " | ".join(map(str, [name, *row, sum(counts[kind] for kind in WORDS)])), "|")
    assert counts.keys() <= HARMLESS | WORDS


def test_another_claim_that_holds_has_another_digest(tmp_path):
    """The band's worst frequency is at its other end: from 9.09 Hz on it promises no less."""
    unchanged, narrow = (
        store.load_with_digest(edited_file(tmp_path / "g.npz", original("shaped"), change))
        for change in (changed(*BAND), changed(*BAND, low_hz=9.09))
    )
    assert narrow[0].recertify().passed
    assert narrow[1] != unchanged[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "beauty"}, "the design does not claim what was checked: beauty"),
        ({"limit": 2.0}, "the check 'radius'.limit must be 1.0 for this design; got 2.0"),
        ({"computed_by": "a guess"}, "the check 'radius'.computed_by must be 'eigenvalues'"),
        ({"more": 1}, "the check 'radius'.more is not known"),
        ({"value": "small"}, "the value of 'radius' must be a number"),
        (None, "the certificate lacks a check of the design: radius"),
    ],
)
def test_a_certificate_that_says_something_else(change, words):
    check = {"name": "radius", "value": 0.5, "limit": 1.0, "computed_by": "eigenvalues"}
    store.require_certificate([check], [check])
    checks = [] if change is None else [check | change]
    refused(lambda: store.require_certificate(checks, [check]), ValueError, re.escape(words))


def test_long_values_are_cut_in_messages():
    words = "must be 'short' for this design; got 'x{56}[.]{3}$"  # 61 signs with the quotes
    refused(lambda: store.require_same("x" * 59, "short", "name"), ValueError, words)
