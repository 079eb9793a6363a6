"""Gain files: round trips, damage, tampering, hostile files."""

import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import astuple, replace

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.exports import relative
from support.gain_file_edits import (
    COMMANDS,
    ENDINGS,
    ORIGINALS,
    Edit,
    command,
    judge,
    random_edits,
    run_quietly,
    saved,
)
from support.gain_files import DESIGNS, edited_file
from support.lqg import shell, slow_plant
from support.plants import LBT_YAML, ROOT
from support.shaping import shaped_design
from support.specula_filters import noise_series, simulate_commands

import lbt_synth as lbt
from lbt_synth.files.gain_file.store import load_with_digest, require_certificate, require_same
from lbt_synth.storage.array_file import npz_bytes


def state_space_filter(path):
    """Read a FITS file as SPECULA's state-space filter does, and return its step function.

    HDUs by name, new state first: x <- A x + B u, y = C x + D u.
    """
    with fits.open(path) as hdus:
        assert hdus[0].header.get("VERSION", 1) == 1
        assert hdus[0].data is None
        A, B, C, D = (hdus[name].data.copy() for name in "ABCD")
        assert hdus[0].header["NFILTER"] == B.shape[1]
        assert hdus[0].header["NSTATES"] == A.shape[0]
    assert C.shape == (B.shape[1], A.shape[0])
    assert D.shape == (B.shape[1], B.shape[1])
    x = np.zeros(len(A))

    def step(u):
        nonlocal x
        x = A @ x + B @ u
        return C @ x + D @ u

    return step


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_fits_file_drives_a_foreign_state_space_filter(tmp_path, name):
    design = DESIGNS[name]
    step = state_space_filter(lbt.save_gain(tmp_path / "g.fits", design))
    run = design.controller.start()
    for y in np.random.default_rng(0).standard_normal((100, 2)):
        assert np.allclose(step(y), run.step(y), rtol=1e-13, atol=1e-13)


def test_fits_headers_speak_to_people(tmp_path):
    header = fits.getheader(lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"]))
    assert header["METHOD"] == "kalman"
    assert header["RATE_HZ"] == 800
    assert header["DELAY"] == 2.5
    assert header["NEWSTATE"] is True
    assert header["RMS"] == pytest.approx(DESIGNS["kalman"].rms)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("mirror", [None, "slow"])
def test_gain_files(tmp_path, ending, mirror):
    plant = slow_plant(2.0, shell() if mirror else None, modes=2)
    design = lbt.lqg(plant, command_weight=0.01)
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"x.{ending}", design))
    assert isinstance(loaded, lbt.design.LqgDesign)
    assert loaded.recertify().passed
    np.testing.assert_array_equal(loaded.controller.A, design.controller.A)
    np.testing.assert_array_equal(loaded.gain_mirror, design.gain_mirror)
    assert loaded.command_weight == 0.01
    assert loaded.objective_nm == design.objective_nm
    if mirror:
        assert astuple(loaded.hardware.mirror) == astuple(plant.hardware.mirror)
    else:
        assert loaded.hardware.mirror is None
    other = lbt.load_gain(lbt.save_gain(tmp_path / f"k.{ending}", lbt.kalman(plant)))
    assert other.recertify().passed
    np.testing.assert_array_equal(other.hardware.mirror_taps, plant.hardware.mirror_taps)


def test_a_gain_file_that_does_not_fit_its_mirror_is_refused(tmp_path):
    def change(document):
        document["arrays"]["GAIN_MIRROR"][0].pop()

    path = edited_file(tmp_path / "p.npz", lbt.lqg(slow_plant(2.0, shell())), change)
    with pytest.raises(lbt.errors.GainFileError, match="gain_mirror must be"):
        lbt.load_gain(path)


@pytest.fixture
def small():
    return shaped_design()


@pytest.mark.parametrize("ending", [".fits", ".npz"])
def test_a_shaped_design_returns_from_its_gain_file(small, tmp_path, ending):
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"gain{ending}", small))
    assert isinstance(loaded, lbt.design.ShapedDesign)
    assert loaded.recertify().passed
    assert loaded.objective_nm == small.objective_nm
    assert [d.label for d in loaded.specifications[0].demands] == [
        d.label for d in small.specifications[0].demands
    ]
    assert loaded.terms_nm() == small.terms_nm()
    np.testing.assert_array_equal(loaded.controller.A, small.controller.A)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["claims"].update(objective_nm=[-1.0]), "must be at least 0"),
        (lambda m: m["claims"].update(beauty=1.0), "does not claim beauty"),
        (lambda m: m.update(long_objective_nm=["inf"]), "long_objective_nm must be a number"),
        (lambda m: m["claims"].update(objective_nm=[30.0, 30.0]), "one for each mode"),
        (
            lambda m: m.update(specifications=[{"kind": "ModulusMargin", "at_least": 0.5}]),
            "expected a Specification",
        ),
        (lambda m: m.update(specifications=[3]), "expected a Specification"),
        (
            lambda m: m["specifications"][0]["objective"]["terms"][1].update(high_hz=900.0),
            "below the Nyquist",
        ),
        (lambda m: m["specifications"][0].update(kind="Anything"), "Anything"),
    ],
)
def test_impossible_claims_of_a_gain_file_are_refused(small, tmp_path, change, message):
    path = edited_file(tmp_path / "gain.npz", small, lambda document: change(document["meta"]))
    with pytest.raises(lbt.errors.GainFileError, match=message):
        lbt.load_gain(path)


def test_the_proof_travels_with_the_gain_file(tmp_path, axis_plant):
    design = lbt.hinf(axis_plant, gamma_ratio=1.1)
    for ending in (".fits", ".npz"):
        loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"g{ending}", design))
        assert loaded.gamma_infeasible == design.gamma_infeasible
        assert np.array_equal(loaded.witness.states, design.witness.states)
        assert loaded.recertify().passed


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
        for one, other in zip(back.fallbacks, design.fallbacks, strict=True):
            assert one.missing == other.missing
            assert np.array_equal(one.gains, other.gains)
    assert back.claims == design.claims
    if design.hardware is not None:
        assert back.hardware.suite.is_same(design.hardware.suite)
        assert back.hardware.delay_frames == design.hardware.delay_frames
        assert np.array_equal(back.hardware.sensor, design.hardware.sensor)


@pytest.mark.parametrize("name", ["kalman", "sensors"])
def test_vibrations_survive(tmp_path, name):
    plant = DESIGNS[name].problem
    back = lbt.load_gain(lbt.save_gain(tmp_path / "g.fits", DESIGNS[name])).problem
    assert back.vibrations == plant.vibrations
    assert back.motions == plant.motions


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


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """The gain file of the Kalman filter, by its format."""
    target = tmp_path_factory.mktemp("kalman") / "g"
    return {
        ending: lbt.save_gain(target.with_suffix(f".{ending}"), DESIGNS["kalman"]).read_bytes()
        for ending in ENDINGS
    }


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    ending=st.sampled_from(ENDINGS), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7)
)
def test_a_flipped_bit_is_found_or_harmless(tmp_path, contents, ending, place, bit):
    path = tmp_path / f"g.{ending}"
    content = bytearray(contents[ending])
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
    notes = tmp_path / "notes.npz"
    notes.write_bytes(npz_bytes({}, '{"schema": "recipes"}'))
    prose = tmp_path / "prose.npz"
    prose.write_bytes(npz_bytes({}, "[1, 2]"))
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, META=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for path in (picture, other, notes, prose, pickled):
        with pytest.raises(lbt.errors.GainFileError, match=f"{path.name} is "):
            lbt.load_gain(path)


def edited(tmp_path, change, **more):
    return edited_file(tmp_path / "g.npz", DESIGNS["kalman"], change, **more)


def test_an_edited_gain_does_not_match_its_digest(tmp_path):
    def change(document):
        document["arrays"]["GAIN_PREDICTOR"][0][0] *= 1.0001

    with pytest.raises(lbt.errors.GainFileError, match="does not match its digest"):
        lbt.load_gain(edited(tmp_path, change, digest_again=False))


@pytest.mark.parametrize("version", [1, 99])
def test_another_layout_is_refused_with_the_way_to_make_the_file_again(tmp_path, version):
    def change(document):
        document["meta"].update(schema_version=version, library_version="0.2.0")

    said = (
        f"layout version {version}, of lbt_synth 0.2.0; this version reads 5. Design it again "
        "with lbt-synth design CONFIG --method METHOD -o FILE."
    )
    with pytest.raises(lbt.errors.SchemaVersionError, match=said):
        lbt.load_gain(edited(tmp_path, change))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda d: d["arrays"].pop("A"), "A is missing"),
        (lambda d: d["arrays"].update(B=[[1.0]]), "B must be"),
        (lambda d: d["arrays"].update(GAIN_FILTER=[[1.0]]), "gain_filter must"),
        (lambda d: d["arrays"].update(A=[[float("nan")]]), "A must be finite"),
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

    with pytest.raises(lbt.errors.GainFileError, match="A is not what plant, loop and gains make"):
        lbt.load_gain(edited(tmp_path, change))


def test_endings_and_missing_files(tmp_path):
    with pytest.raises(lbt.errors.OutputError, match="must end in .fits, .npz; got 'g.txt'"):
        lbt.save_gain(tmp_path / "g.txt", DESIGNS["kalman"])
    for ending in ("txt", "json"):
        with pytest.raises(
            lbt.errors.GainFileError, match=f"must end in .fits, .npz; got 'g.{ending}'"
        ):
            lbt.load_gain(tmp_path / f"g.{ending}")
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
        "null",
        "[" * 100_000,
        '{"schema": "lbt_synth gain file", "x": NaN}',
        '{"schema": "lbt_synth gain file", "schema": "lbt_synth gain file"}',
        "\x00",
    ],
)
def test_hostile_metadata(tmp_path, text):
    path = tmp_path / "h.npz"
    path.write_bytes(npz_bytes({}, text))
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
        lbt.load_gain("x\0y.npz")
    with pytest.raises(lbt.errors.OutputError, match="null"):
        lbt.save_gain("x\0y.npz", DESIGNS["bare"])


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
    with pytest.raises(lbt.errors.GainFileError, match="the checksum of its HDU 0 is wrong"):
        lbt.load_gain(path)


def test_a_header_that_says_something_else_is_found_behind_a_right_checksum(tmp_path):
    with fits.open(lbt.save_gain(tmp_path / "g.fits", DESIGNS["kalman"])) as hdus:
        hdus[0].header["RATE_HZ"] = 900.0
        hdus.writeto(tmp_path / "other.fits", checksum=True)
    with pytest.raises(lbt.errors.GainFileError, match="header.RATE_HZ must be 800.0"):
        lbt.load_gain(tmp_path / "other.fits")


def test_the_header_counts_the_measurements_of_all_sensors(tmp_path):
    design = DESIGNS["sensors"]
    header = fits.getheader(lbt.save_gain(tmp_path / "g.fits", design))
    assert header["NFILTER"] == design.problem.n_measurements


def test_only_designs_are_saved(tmp_path):
    with pytest.raises(lbt.errors.ProblemError, match="design must be a Design; got int"):
        lbt.save_gain(tmp_path / "g.fits", 3)
    twisted = replace(DESIGNS["kalman"])
    k = twisted.controller
    object.__setattr__(twisted, "controller", replace(k, B=1.001 * k.B))
    with pytest.raises(lbt.errors.OutputError, match="contradicts itself: B is not what plant"):
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
        "integrator": lbt.design.optimal_integrator(loaded.hardware, loaded.truth),
    }


@pytest.fixture(scope="module", params=[0, 1], ids=["double", "single"])
def specula_run(request, simulated_designs, tmp_path_factory):
    """Commands of each gain file in SPECULA, in the closed loop and on given measurements."""
    folder = tmp_path_factory.mktemp("specula")
    output = folder / "commands.npz"
    files = [lbt.save_gain(folder / f"{name}.fits", simulated_designs[name]) for name in NAMES]
    done = subprocess.run(
        [sys.executable, SCRIPT, str(request.param), output, LBT_YAML, *files],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(output) as data:
        series = {name: (data[f"loop{i}"], data[f"noise{i}"]) for i, name in enumerate(NAMES)}
    return request.param, series


@pytest.mark.e2e
@pytest.mark.parametrize("name", NAMES)
def test_the_closed_loop_is_that_of_our_simulator(simulated_designs, specula_run, name):
    """Same disturbance and noise: SPECULA's filter in the loop, and our simulator."""
    precision, series = specula_run
    expected = simulate_commands(simulated_designs[name].controller, LBT_YAML)
    assert np.max(np.abs(expected)) > 100  # nm: there is something to correct
    assert relative(series[name][0], expected) < LIMITS[precision]


@pytest.mark.e2e
@pytest.mark.parametrize("name", NAMES)
def test_the_same_measurements_give_the_same_commands(simulated_designs, specula_run, name):
    """The gain file untouched, against the stepped controller, on measurements of no loop."""
    precision, series = specula_run
    ours = simulated_designs[name].controller.start()
    expected = np.array([ours.step(y) for y in noise_series(2)])
    assert relative(series[name][1], expected) < LIMITS[precision]


HARMLESS = ("refused", "no other design", "another claim that holds", "cannot be written")
QUICK = ("kalman", "bare", "integrator")


def refused_commands(name, ending, folder, commands):
    """Commands that do not take a file as it was written."""
    path = saved(name, ending).write(folder / f"{name}.{ending}")
    return [each for each in commands if run_quietly(command(each, path))[0] != 0]


def test_a_sample_of_edits(tmp_path):
    for name, ending in zip(QUICK, (*ENDINGS, "npz"), strict=True):
        assert not refused_commands(name, ending, tmp_path, ("verify",))
    verdicts = [judge(edit, tmp_path, ("verify",)) for edit in random_edits(40, 1, QUICK)]
    assert set(verdicts) <= set(HARMLESS), verdicts
    assert verdicts.count("refused") > 30


@pytest.mark.study
def test_no_edit_is_taken_for_a_certified_design(tmp_path, capsys):
    """2,000 edits over methods and formats print the table of docs/gain_file.md."""
    for name in ORIGINALS:
        for ending in ENDINGS:
            assert not refused_commands(name, ending, tmp_path, ("verify", "show", "export"))
    assert not refused_commands("kalman", "npz", tmp_path, ("simulate",))
    counts = {name: Counter() for name in ORIGINALS}
    told = []
    for number, edit in enumerate(random_edits(2000)):
        verdict = judge(edit, tmp_path, COMMANDS if number % 10 == 0 else ("verify",))
        kind = verdict if verdict in HARMLESS else verdict.split()[0]
        counts[edit.design][kind] += 1
        if kind not in HARMLESS or (kind == "no other design" and not edit.is_note):
            told.append((verdict, edit.design, edit.ending, edit.place, edit.change))
    kinds = (*HARMLESS, "certified", "traceback", "more")
    with capsys.disabled():
        print(f"\n| design | {' | '.join(kinds)} |")
        for name, each in counts.items():
            print(f"| {name} | {' | '.join(str(each[kind]) for kind in kinds)} |")
        print(f"| all | {' | '.join(str(sum(c[k] for c in counts.values())) for k in kinds)} |")
        print(*told, sep="\n")
    assert not [entry for entry in told if entry[0] not in HARMLESS]


def test_another_claim_that_holds_has_another_digest(tmp_path):
    """The band's worst frequency is at its other end: from 9.09 Hz on it promises no less."""
    place = ("meta", "specifications", 0, "objective", "terms", 1, "low_hz")
    edit = Edit("shaped", "npz", place, "times 1.01", 9.09)
    assert judge(edit, tmp_path, ("verify",)) == "another claim that holds"
    contents = (saved("shaped", "npz"), saved("shaped", "npz").changed(edit))
    digests = [load_with_digest(each.write(tmp_path / "g.npz"))[1] for each in contents]
    assert digests[0] != digests[1]
    wider = replace(edit, place=(*place[:-1], "high_hz"), value=12.0)  # it leaves more there
    assert judge(wider, tmp_path, ("verify",)) == "refused"


def test_a_demand_that_is_there_twice_is_refused(tmp_path):
    place = ("meta", "specifications", 0, "demands")
    demands = saved("shaped", "npz").parts["meta"]["specifications"][0]["demands"]
    edit = Edit("shaped", "npz", place, "longer", [*demands, *demands])
    assert judge(edit, tmp_path, ("verify",)) == "refused"


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
    with pytest.raises((ValueError, lbt.errors.ProblemError), match=re.escape(words)):
        require_certificate(checks, [check])


def test_long_values_are_cut_in_messages():
    with pytest.raises(ValueError, match="must be 'short' for this design; got 'x{56}[.]{3}$"):
        require_same("x" * 90, "short", "name")
