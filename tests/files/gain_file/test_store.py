"""Gain files: round trips, damage, tampering, hostile files."""

import copy
import functools
import json
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
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
from lbt_synth.files.gain_file.store import (
    load_with_digest,
    require_agreement,
    require_certificate,
    require_same,
)
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz

ENDINGS = ("fits", "npz")


def state_space_filter(path):
    """Return the step function of a FITS file, read as SPECULA's state-space filter does.

    HDUs by name, new state first: x <- A x + B u, y = C x + D u.
    """
    with fits.open(path) as hdus:
        header = hdus[0].header
        assert header.get("VERSION", 1) == 1
        assert hdus[0].data is None
        A, B, C, D = (hdus[name].data.copy() for name in "ABCD")
    n, q = header["NSTATES"], header["NFILTER"]
    assert [X.shape for X in (A, B, C, D)] == [(n, n), (n, q), (q, n), (q, q)]
    x = np.zeros(n)

    def step(u):
        nonlocal x
        x = A @ x + B @ u
        return C @ x + D @ u

    return step


def test_records_agree_to_the_last_digits():
    """To 1e-9 of an entry; what is further apart is named, with its part of the largest entry."""
    record = record_design(original("kalman"))
    B = record.arrays["B"]
    place = np.unravel_index(np.argmax(np.abs(B)), B.shape)

    def changed(part):
        moved = B.copy()
        moved[place] *= 1 + part
        return replace(record, arrays=record.arrays | {"B": moved})

    require_agreement(changed(0.9e-9), record)
    with pytest.raises(ValueError, match="B is not what .*differs by 1.1e-09 of the largest"):
        require_agreement(changed(1.1e-9), record)
    with pytest.raises(ValueError, match="differs by 0.2 of the largest"):
        require_agreement(changed(0.25), record)  # 1.25 is the largest


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "sensors"])
def test_a_fits_file_speaks_to_people_and_drives_a_foreign_filter(tmp_path, name):
    design = original(name)
    path = lbt.save_gain(tmp_path / "g.fits", design)
    header = fits.getheader(path)
    assert (header["METHOD"], header["RATE_HZ"], header["DELAY"]) == (design.method, 800, 2.5)
    assert header["NEWSTATE"] is True
    assert header["NFILTER"] == design.controller.B.shape[-1]
    if name != "integrator":
        assert header["RMS"] == pytest.approx(design.rms)
    if name == "sensors":  # its matrices change from frame to frame
        return
    step, run = state_space_filter(path), design.controller.start()
    for y in np.random.default_rng(0).standard_normal((100, 2)):
        assert np.allclose(step(y), run.step(y), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("name", "ending"), [*zip(ORIGINALS, cycle(ENDINGS), strict=False)])
def test_round_trip_keeps_every_bit(tmp_path, name, ending):
    design = original(name)
    back = lbt.load_gain(lbt.save_gain(tmp_path / f"gain.{ending}", design))
    assert type(back) is type(design)
    assert type(back.problem) is type(design.problem)
    one, other = record_design(design), record_design(back)
    assert one.arrays.keys() == other.arrays.keys()
    assert all(np.array_equal(array, other.arrays[key]) for key, array in one.arrays.items())
    assert json.dumps(one.meta) == json.dumps(other.meta)
    for field in "ABCD":
        assert np.array_equal(getattr(back.controller, field), getattr(design.controller, field))
    assert back.controller.dt_s == design.controller.dt_s
    assert (back.solver, back.claims) == (design.solver, design.claims)
    assert back.certificate.checks == design.certificate.checks
    assert back.recertify().passed
    if isinstance(design, ShapedDesign):
        assert back.terms_nm() == design.terms_nm()
    if design.hardware is not None:
        assert back.hardware.suite.is_same(design.hardware.suite)
        assert np.array_equal(back.hardware.mirror_taps, design.hardware.mirror_taps)


def scale_gain(document):
    document["arrays"]["GAIN_PREDICTOR"][0][0] *= 1.01


def arrays(**changes):
    return lambda document: document["arrays"].update(changes)


def meta(**changes):
    return lambda document: document["meta"].update(changes)


def claims(**changes):
    return lambda document: document["meta"]["claims"].update(changes)


def in_specification(*keys, **changes):
    def change(document):
        place = document["meta"]["specifications"][0]
        for key in keys:
            place = place[key]
        place.update(changes)

    return change


BAND = ("terms", 1)
AGAIN = "Design it again with lbt-synth design CONFIG --method METHOD -o FILE."
SPECIFICATION = "expected a Specification"
MARGIN = {"kind": "Bound", "response": "rejection", "at_most": 2.0}


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("kalman", scale_gain, "A is not what plant, loop and gains make"),
        ("kalman", lambda d: d["arrays"].pop("A"), "A is missing"),
        ("kalman", arrays(B=[[1.0]]), "B must be"),
        ("kalman", arrays(GAIN_PREDICTOR=[[1.0]]), "gain_predictor must"),
        ("kalman", arrays(A=[[float("nan")]]), "A must be finite"),
        ("kalman", lambda d: d["meta"].pop("certificate"), "certificate is missing"),
        ("kalman", meta(problem="riddle"), "riddle"),
        ("kalman", meta(delay_frames=-1), "delay_frames must be"),
        ("lqg", lambda d: d["arrays"]["GAIN_MIRROR"].pop(), "gain_mirror must be"),
        (
            "kalman",
            meta(schema_version=99, library_version="0.2.0"),
            f"layout version 99, of lbt_synth 0.2.0; this version reads 5. {AGAIN}",
        ),
        ("kalman", meta(schema_version=1), "layout version 1, of"),
        ("shaped", claims(objective_nm=[-1.0]), "must be at least 0"),
        ("shaped", claims(beauty=1.0), "does not claim beauty"),
        ("shaped", meta(long_objective_nm=["inf"]), "long_objective_nm must be a number"),
        ("shaped", claims(objective_nm=[30.0, 30.0]), "one for each mode"),
        ("shaped", meta(specifications=[MARGIN]), SPECIFICATION),
        ("shaped", meta(specifications=[3]), SPECIFICATION),
        ("shaped", in_specification(*BAND, high_hz=900.0), "below the Nyquist"),
        ("shaped", in_specification(kind="Anything"), "Anything"),
        ("shaped", in_specification(*BAND, high_hz=12.0), ""),  # it leaves more there
        ("shaped", lambda d: double_demands(d["meta"]["specifications"][0]), ""),
    ],
)
def test_files_that_were_edited_and_signed_anew_are_refused(tmp_path, name, change, text):
    error = SchemaVersionError if "layout" in text else GainFileError
    path = edited_file(tmp_path / "g.npz", original(name), change)
    refused(lambda: lbt.load_gain(path), error, text or None)


def double_demands(specification):
    specification["demands"] *= 2


def test_a_file_that_was_edited_and_not_signed_does_not_match_its_digest(tmp_path):
    path = edited_file(tmp_path / "g.npz", original("kalman"), scale_gain, digest_again=False)
    with pytest.raises(GainFileError, match="does not match its digest"):
        lbt.load_gain(path)
    path = lbt.save_gain(tmp_path / "g.fits", original("kalman"))
    card, content = b"RATE_HZ =                800.0", path.read_bytes()
    assert card in content
    path.write_bytes(content.replace(card, card.replace(b"8", b"9")))
    with pytest.raises(GainFileError, match="the checksum of its HDU 0 is wrong"):
        lbt.load_gain(path)
    # a header that says something else is found behind a right checksum
    with fits.open(lbt.save_gain(path, original("kalman"))) as hdus:
        hdus[0].header["RATE_HZ"] = 900.0
        hdus.writeto(tmp_path / "other.fits", checksum=True)
    with pytest.raises(GainFileError, match="header.RATE_HZ must be 800.0"):
        lbt.load_gain(tmp_path / "other.fits")


def test_only_designs_are_saved(tmp_path):
    with pytest.raises(ProblemError, match="design must be a Design; got int"):
        lbt.save_gain(tmp_path / "g.fits", 3)
    twisted = replace(original("kalman"))
    k = twisted.controller
    object.__setattr__(twisted, "controller", replace(k, B=1.001 * k.B))
    with pytest.raises(OutputError, match="contradicts itself: B is not what plant"):
        lbt.save_gain(tmp_path / "g.fits", twisted)
    assert not (tmp_path / "g.fits").exists()


SCRIPT = ROOT / "tests" / "support" / "specula_filters.py"
NAMES = ["kalman", "hinf", "integrator"]
LIMITS = (1e-12, 1e-5)  # in double and in single precision


@pytest.fixture(scope="module")
def simulated_designs():
    loaded = lbt.load_config(LBT_YAML)
    return {
        "kalman": lbt.kalman(loaded.plant),
        "hinf": lbt.hinf(loaded.plant, gamma_ratio=1.2),
        "integrator": lbt.integrator(loaded.hardware, truth=loaded.truth),
    }


@pytest.fixture(scope="module", params=[0, 1], ids=["double", "single"])
def specula_run(request, simulated_designs, tmp_path_factory):
    """Commands of each gain file in SPECULA, in the closed loop and on given measurements."""
    folder = tmp_path_factory.mktemp("specula")
    output = folder / "commands.npz"
    files = [lbt.save_gain(folder / f"{name}.fits", simulated_designs[name]) for name in NAMES]
    call = [sys.executable, SCRIPT, str(request.param), output, LBT_YAML, *files]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(output) as data:
        series = {name: (data[f"loop{i}"], data[f"noise{i}"]) for i, name in enumerate(NAMES)}
    return request.param, series


@pytest.mark.e2e
@pytest.mark.parametrize("name", NAMES)
def test_specula_commands_what_our_simulator_does(simulated_designs, specula_run, name):
    """Its filter in the loop, and on measurements of no loop, with the gain file untouched."""
    precision, series = specula_run
    controller = simulated_designs[name].controller
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
    if isinstance(value, np.ndarray):
        one = value.copy()
        one.flat[np.argmax(np.abs(value))] *= 1.01
        other = [one, 0.8 * value, value[:-1], value[None], np.full_like(value, np.nan)]
    elif isinstance(value, bool):
        other = [not value, "yes"]
    elif isinstance(value, int | float):
        other = [1.01 * value, 7 * value, -value, 0.0, 1e300, float("nan"), str(value), [value]]
    elif isinstance(value, str):
        other = ["kalman", "hinf", "integrator", "lqg", "plant", value + " x", "", "\ud800", 3]
    elif isinstance(value, list):
        other = [value[:-1], [*value, 1.0], [*value, *value], "list"]
    elif isinstance(value, dict):
        other = [list(value), value | {"more": 1}, "dict"]
    else:
        other = [100.0, "none", []]
    if isinstance(value, np.ndarray):
        return [*(new for new in other if not np.array_equal(new, value)), None, MISSING]
    return [new for new in [*other, None, MISSING] if type(new) is not type(value) or new != value]


def without_notes(value):
    if isinstance(value, dict):
        return {key: without_notes(each) for key, each in value.items() if key not in NOTES}
    return [without_notes(each) for each in value] if isinstance(value, list | tuple) else value


def difference(one, other):
    """Say whether two designs are the same but for notes, or another word beside equal claims."""
    one, other = record_design(one), record_design(other)
    equal = one.arrays.keys() == other.arrays.keys() and all(
        np.shape(array) == np.shape(other.arrays[name])
        and np.allclose(array, other.arrays[name], rtol=1e-12, atol=0)
        for name, array in one.arrays.items()
    )
    if not equal or one.meta["claims"] != other.meta["claims"]:
        return "another design"
    same = without_notes(one.meta) == without_notes(other.meta)
    return "the same design" if same else "another word"


def outcome(name, parts, place, new, path):
    """Say what comes of a file of which one field was changed and the digest written again."""
    document = copy.deepcopy(parts)
    *before, last = place
    branch = functools.reduce(lambda at, key: at[key], before, document)
    if new is MISSING:
        del branch[last]
    else:
        branch[last] = new
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
    kind = difference(back, original(name))
    return f"{kind}: {place[-1]}" if kind == "another word" else kind


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
    """The rows of the table of docs/gain_file.md."""
    counts = outcomes(name, 180, tmp_path)
    with capsys.disabled():
        row = [counts[kind] for kind in ("refused", "the same design", "cannot be written")]
        print("|", " | ".join(map(str, [name, *row, sum(counts[kind] for kind in WORDS)])), "|")
    assert counts.keys() <= HARMLESS | WORDS


def test_another_claim_that_holds_has_another_digest(tmp_path):
    """The band's worst frequency is at its other end: from 9.09 Hz on it promises no less."""
    unchanged, narrow = (
        load_with_digest(edited_file(tmp_path / "g.npz", original("shaped"), change))
        for change in (in_specification(), in_specification(*BAND, low_hz=9.09))
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
    require_certificate([check], [check])
    checks = [] if change is None else [check | change]
    with pytest.raises((ValueError, ProblemError), match=re.escape(words)):
        require_certificate(checks, [check])


def test_long_values_are_cut_in_messages():
    with pytest.raises(ValueError, match="must be 'short' for this design; got 'x{56}[.]{3}$"):
        require_same("x" * 59, "short", "name")  # 61 signs with the quotes
