"""The exported C source, compiled and run beside the controller."""

import json
import re
import subprocess
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.compiled import STRICT, Compiled, compiler
from support.exports import bare_design, lbt_designs, relative
from support.predictors import made
from support.refusals import refused, require_refusals
from support.sensor_loops import SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.result import SolverReport
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop import pipeline, proof
from lbt_synth.interop.c import export as c_export
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.interop.c.terms import RunningSource, read_source, source_terms
from lbt_synth.interop.proof import rehearsal_error
from lbt_synth.linear import estimator_form
from lbt_synth.loop.simulation import Drop

LIMITS = {"double": 1e-12, "single": 1e-5}
KINDS = {"double": np.float64, "single": np.float32}
FORMS = ("plain", "estimator")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Function that writes ``ctl.c`` of a design, a form and a precision, each of them once."""

    @cache
    def write(name, form="plain", precision="double"):
        target = tmp_path_factory.mktemp("exported") / "ctl.c"
        options = {"form": form, "precision": precision}
        return lbt.interop.export(target, lbt_designs()[name], "c", **options)

    return write


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "turned"])
def test_the_source_is_what_was_proved(exported, designs, name, form, precision):
    """Bit for bit; the numbers in its text, its error in the loop and its commands are those."""
    design, single, applies = designs[name], precision == "single", form == "estimator"
    written = exported(name, form, precision)
    compiled = Compiled(written.files[0], single=single)
    assert rehearsal_error(design, compiled) == written.error < LIMITS[precision]
    if name != "integrator":
        assert written.error > single * 1e-9
    names = [check.name for check in written.checks]
    assert names[0].startswith("spectral radius at sensor gains")
    assert (names[-1] == "spectral radius of the estimator alone") == applies
    assert all(check.passed for check in written.checks)
    beside = json.loads(written.files[2].read_text())
    assert (beside["form"], beside["precision"]) == (form, precision)

    exact = estimator_form(design) if applies else design.controller
    terms = source_terms(design, form=form)
    numbers = read_source(written.files[0].read_text(), terms)
    pairs = (
        (numbers.transition[0], [exact.A, exact.applied if applies else 0 * exact.B]),
        (numbers.gains[frozenset()][0], [exact.B]),
        (numbers.command, [exact.C, np.zeros((2, 2)) if applies else exact.D]),
    )
    for matrix, parts in pairs:
        assert np.array_equal(matrix, np.hstack(parts).astype(KINDS[precision]))

    compiled.reset()
    twin = RunningSource(terms.rounded() if single else terms)
    textbook, commands = exact.start(), []
    for y, applied in np.random.default_rng(6).standard_normal((50, 2, 2)):
        more = [applied] * applies
        commands.append((textbook.step(y, *more), compiled.step(y, *more)))
        assert np.array_equal(twin.step(y, None, *more), commands[-1][1])
    assert relative(*np.moveaxis(commands, 1, 0)) < {"double": 1e-10, "single": 1e-3}[precision]
    shared = y.astype(compiled.real)  # one array for all: nothing is written before it is read
    expected = twin.step(shared, None, *[shared] * applies)
    compiled._call("step", compiled.state, *[shared] * (2 + applies))
    assert np.array_equal(shared, expected)


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_what_is_not_finite_holds_command_and_state(exported, name, form, precision):
    """In arrays of their own, and where commands share one with the measurements."""
    source = exported(name, form, precision).files[0]
    spoilt, clean = (Compiled(source, single=precision == "single") for _ in range(2))
    rng, before, arrays = np.random.default_rng(4), np.zeros(2), 1 + (form == "estimator")
    for y in rng.standard_normal((60, 2)):
        inputs = np.array([y, before][:arrays])
        bad = inputs.copy()
        bad.flat[rng.integers(bad.size)] = rng.choice([np.nan, np.inf, -np.inf])
        spoilt.u[:] = 99.0
        assert np.array_equal(spoilt.step(*bad), before)
        assert spoilt.status == 1
        shared = np.array([np.nan, 1.0], dtype=spoilt.real)
        spoilt._call("step", spoilt.state, *[shared] * (1 + arrays))
        assert np.array_equal(shared, before)
        before = clean.step(*inputs)
        assert np.array_equal(spoilt.step(*inputs), before)
        assert np.array_equal(spoilt.state, clean.state)
        assert spoilt.status == clean.status == 0


@st.composite
def controllers(draw):
    """Stable controllers of all shapes: sparse and dense, zero rows, signs, no feedthrough."""
    n, q, m = (draw(st.integers(1, high)) for high in (22, 4, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    density = draw(st.sampled_from([0.0, 0.2, 0.6, 1.0]))

    def matrix(rows, columns):
        values = rng.standard_normal((rows, columns)) * (rng.random((rows, columns)) < density)
        return np.where(rng.random((rows, columns)) < 0.1, np.sign(values), values)

    A = matrix(n, n)
    if draw(st.booleans()):
        A[rng.integers(n)] = 0
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    A = A if radius < 0.9 else A * (0.9 / radius)
    D = matrix(m, q) * draw(st.booleans())
    return lbt.Controller(A=A, B=matrix(n, q), C=matrix(m, n), D=D, dt_s=0.002)


def operations(source):
    """Products and sums of a step, counted in the text outside the table of gains."""
    sums = "".join(re.findall(r"=\n([^;]*);", source.read_text().split("_step(")[1]))
    return np.array([sums.count(" * "), sums.count(" + ") + sums.count(" - ")])


@pytest.mark.usefixtures("short_rehearsal")
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(controller=controllers(), precision=st.sampled_from(list(LIMITS)))
def test_any_stable_controller(tmp_path, controller, precision):
    design = bare_design(controller)
    source = lbt.interop.export(tmp_path / "any.c", design, "c", precision=precision).files[0]
    cost = frame_cost(controller)
    assert (cost.multiplications, cost.additions) == tuple(operations(source))
    compiled, exact = Compiled(source, single=precision == "single"), controller.start()
    series = np.random.default_rng(2).standard_normal((200, controller.B.shape[1]))
    expected, commands = (np.array([run.step(y) for y in series]) for run in (exact, compiled))
    largest = np.max(np.abs(np.concatenate([[1.0], exact.state, expected.ravel()])))
    assert np.max(np.abs(commands - expected)) < LIMITS[precision] * largest


def test_the_comments_say_what_it_is_and_where_it_comes_from(tmp_path, designs):
    sha, design = "ab" * 32, designs["kalman"]
    written = lbt.interop.export(tmp_path / "k.c", design, "c", gain_digest=sha)
    source, header = (file.read_text() for file in written.files[:2])
    words = (lbt.__version__, "kalman (riccati)", sha, "800.0 Hz", "2.0 frames", "nm rms")
    for word in (*words, f"{len(design.certificate.checks)} checks passed"):
        assert word in source
        assert word in header
    assert f'#define K_GAIN_SHA256 "{sha}"' in header
    several = lbt.kalman(example_plant((SLOW,)))
    header_of_several = lbt.interop.export(tmp_path / "s.c", several, "c").files[1].read_text()
    assert "fresh[0]     wavefront: y[0] to y[1], every frame\n" in header_of_several
    assert "fresh[1]     truth: y[2] to y[3], every 4 frames\n" in header_of_several
    numbers = re.findall(r"(-?0x\S+p[+-]\d+), /\* ([ABCD])\[(\d+)\]\[(\d+)\] = (\S+) \*/", source)
    entries = np.abs(np.hstack([getattr(design.controller, name).ravel() for name in "ABCD"]))
    assert len(numbers) == np.sum((entries > 0) & (entries != 1))
    for code, name, i, j, decimal in numbers:
        entry = getattr(design.controller, name)[int(i), int(j)]
        assert float.fromhex(code) == entry == float(decimal)


EVIL = '*/ int main(void) {} /* x\\\n*/ ??/ *\n/ #error \u202e*/ a"b \x00'


@pytest.mark.usefixtures("short_rehearsal")
def test_words_cannot_leave_the_comment(tmp_path, designs):
    check = lbt.design.Check(name=EVIL, value=0.0, limit=1.0, computed_by=EVIL)
    solver = SolverReport(route=EVIL, status=EVIL)
    certificate = replace(designs["integrator"].certificate, checks=(check,))
    facts = {"method": EVIL, "solver": solver, "certificate": certificate}
    design = replace(designs["integrator"], **facts)
    source = lbt.interop.export(tmp_path / "tip-tilt.v2.c", design, "c", name="Tip_tilt2").files[0]
    Compiled(source, name="Tip_tilt2")
    code = source.read_text()
    assert '#include "tip-tilt.v2.h"' in code
    assert code.isascii()
    assert code.count("*/") == code.count("/*")
    assert "main" not in code.split("*/", 1)[1]


@pytest.mark.usefixtures("short_rehearsal")
def test_what_has_no_source_is_refused(tmp_path, config, designs, sensors_design, monkeypatch):
    """Overflowing products, a gain that rounds to the brink, and tables a bit too long."""

    def write(design=designs["integrator"], file="k.c", **options):
        return lambda: lbt.interop.export(tmp_path / file, design, "c", **options)

    terms = source_terms(sensors_design)
    count = sum(np.count_nonzero(gains.any(axis=1)) for gains in terms.gains.values())
    count *= sensors_design.problem.n_states
    steep = bare_design(lbt.Controller(A=[[0.5]], B=[[1e30]], C=[[1e30]], D=[[0.0]]))
    brink = lbt.integrator(config.hardware, gain=1 - 1e-8)  # stable below 1; rounds to 1
    monkeypatch.setattr(c_export, "MOST_GAINS", count)
    for design in (steep, brink, sensors_design):
        for file in write(design)().files:
            file.unlink()
    monkeypatch.setattr(c_export, "MOST_GAINS", count - 1)

    A = np.eye(320) / 2 + 1e-5
    full = bare_design(lbt.Controller(A=A, B=np.ones((320, 1)), C=np.ones((1, 320)), D=[[0.0]]))
    prefix, ending = "prefix of the C names must", (lbt.errors.OutputError, r"must end in \.c")
    single = {"precision": "single"}
    rows = [
        (write(name=name), ProblemError, prefix)
        for name in ("", "2fast", "a b", "_x", "a__b", "ä", "x" * 26, 3, "a\n")
    ]
    rows += [(write(file=file, name="k"), *ending) for file in ("k.h", 'k".c', "..")]
    rows += [
        (write(sensors_design, form="plain"), ProblemError, "in estimator form alone"),
        (write(form="observer"), ProblemError, "form must be one of plain, estimator"),
        (write(steep, form="estimator"), ProblemError, "needs the design of a loop"),
        (write(precision="half"), ProblemError, "must be one of double, single"),
        (write(full), ProblemError, "at most 100,000 numbers in C; got 103,040"),
        (write(sensors_design), ProblemError, rf"got {count:,}, in a period of 2 frames"),
        (write(steep, **single), NumericalError, r"\(single precision\); the commands grow"),
        (write(brink, **single), NumericalError, "what its design promises .* spectral radius"),
    ]
    require_refusals(rows)
    monkeypatch.setattr(c_export, "MOST_GAINS", count)
    monkeypatch.setattr(pipeline, "LOSS", 1e-9)  # single precision is off by more
    words = r"in a rehearsal.*Try double precision"
    refused(write(sensors_design, **single), NumericalError, words)
    assert not list(tmp_path.iterdir())


UNITS = ("wavefront", "slow", "m1", "m2")
MISSING, NOT_FINITE, NOT_DUE, NOT_APPLIED = 1, 2, 4, 8
HELD = 2  # of a predictor


@pytest.fixture(scope="module")
def sensor_files(sensors_design, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masked_c")
    write = partial(lbt.interop.export, design=sensors_design, target="c")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "FRAMES", 500)
        return {kind: write(folder / f"{kind}.c", precision=kind) for kind in LIMITS}


def require_commands(design, truth, drops, written, limit, *, single=False):
    """Require the commands of a simulation, and the twin's bits; return the source that ran."""
    path, options = design.hardware, {"frames": 1200, "settle_frames": 0, "drops": drops}
    run, rows = lbt.simulate(design, truth, hardware=path, **options), path.suite.rows(path)
    readings = [place.stop - place.start for place in rows.values()]
    compiled, twin = Compiled(written.files[0], single=single), written.start(np.inf)
    last, commands = np.zeros(2), []
    for k, (y, u) in enumerate(zip(run.measurements[0], run.commands[0], strict=True)):
        time_s = k / path.frame_rate_hz + 1e-9
        away = {drop.unit for drop in drops if drop.start_s <= time_s < drop.end_s}
        fresh = [unit not in away and not (unit == "slow" and k % 2) for unit in rows]
        stale = np.where(np.repeat(fresh, readings), y, np.nan)  # nobody looks at the others
        commands.append(compiled.step(stale, fresh, last))
        assert compiled.status == MISSING * bool(away)
        expected = twin.step(stale, dict(zip(rows, fresh, strict=True)), last)
        assert np.array_equal(commands[-1], expected)
        last = u
    assert relative(commands, run.commands[0]) < limit
    return compiled


def test_the_commands_are_those_of_the_simulation(sensors_design, sensors_config, sensor_files):
    drops = (
        Drop(unit="m1", start_s=0.1, end_s=0.301),
        Drop(unit="slow", start_s=0.2, end_s=0.5),
        Drop(unit="wavefront", start_s=0.25, end_s=0.3),
        Drop(unit="m2", start_s=0.901),
    )
    require_commands(sensors_design, sensors_config.truth, drops, sensor_files["double"], 1e-9)


@pytest.mark.parametrize("precision", LIMITS)
def test_what_cannot_be_used_is_missing(sensor_files, precision):
    """Bit for bit, at random; the slow sensor is missing from when it is due until it is read."""
    written, rng = sensor_files[precision], np.random.default_rng(0)
    compiled = Compiled(written.files[0], single=precision == "single")
    twin, missing, seen = written.start(np.inf), np.zeros(4, dtype=bool), set()
    for k in range(300):
        y, applied = rng.standard_normal(6), rng.standard_normal(2)
        y[rng.random(6) < 0.1] = rng.choice([np.nan, np.inf, -np.inf])
        lost = rng.random(2) < 0.1
        fresh, due = rng.random(4) < 0.8, np.array([True, k % 2 == 0, True, True])
        finite = np.logical_and.reduceat(np.isfinite(y), [0, 2, 4, 5])
        new = dict(zip(UNITS, (fresh & due & finite).tolist(), strict=True))
        expected = twin.step(y, new, np.where(lost, compiled.u, applied))
        applied[lost] = np.nan
        assert np.array_equal(compiled.step(y, fresh, applied), expected)
        missing = np.where(due, ~(fresh & finite), missing)
        states = np.any([missing, fresh & due & ~finite, fresh & ~due, [any(lost)] * 4], axis=1)
        assert compiled.status == states @ [MISSING, NOT_FINITE, NOT_DUE, NOT_APPLIED]
        seen.add(compiled.status)
    assert len(seen) > 10


def test_a_slip_of_the_phase_is_seen_and_mended(sensor_files):
    """The slow sensor is missing from a frame in which it is due until it is read again."""
    compiled, seen = Compiled(sensor_files["double"].files[0]), []
    for k in range(8):
        if k == 5:
            compiled.phase(10_001)  # of an odd number of frames
        compiled.step(np.zeros(6), [1, (k + 1) % 2 == 0, 1, 1], np.zeros(2))
        seen.append(compiled.status)
    slipped = [MISSING, MISSING | NOT_DUE]
    assert seen == [*slipped, *slipped, MISSING, MISSING | NOT_DUE, MISSING, MISSING | NOT_DUE]
    compiled.phase(0)
    compiled.step(np.zeros(6), [1, 1, 1, 1], np.zeros(2))
    assert compiled.status == 0


def test_names_of_sensors_that_are_no_identifiers(sensors_design):
    terms = source_terms(sensors_design)
    for names, identifiers in (
        (("slow one", "2nd", "m*/"), ["WAVEFRONT", "SLOW_ONE", "2ND", "M"]),
        (("m-1", "m_1", "ä"), ["WAVEFRONT_0", "M_1_1", "M_1_2", "3"]),
        (("x" * 30, "int", "\\\n*/"), ["WAVEFRONT_0", "X" * 24 + "_1", "INT_2", "3"]),
    ):
        rows = dict(zip(("wavefront", *names), terms.rows.values(), strict=True))
        units = c_export._describe_units(replace(terms, rows=rows))
        assert [unit["identifier"] for unit in units] == identifiers
        assert all(unit["name"].isascii() and "*/" not in unit["name"] for unit in units)


def test_the_certificate_and_the_cost_are_those_of_the_source(sensor_files, sensors_design):
    for precision, written in sensor_files.items():
        beside = json.loads(written.files[2].read_text())
        facts = {"form": "estimator", "precision": precision, "period": 2, "sensors": [*UNITS]}
        assert beside.items() >= facts.items()
        assert [check["passed"] for check in beside["checks"]] == [True] * 6
        assert beside["checks"][-1]["value"] == written.error
    assert sensor_files["double"].error < 1e-11 < sensor_files["single"].error < 1e-3
    source, cost = sensor_files["double"].files[0], frame_cost(source_terms(sensors_design))
    gains = 6 * int(re.search(r"add\(state->x, (\d+), gains", source.read_text())[1])
    assert [cost.multiplications, cost.additions] == (operations(source) + gains).tolist()


@pytest.mark.parametrize("precision", LIMITS)
def test_a_predictor_without_a_channel_is_its_fall_back(tmp_path, precision):
    """It holds without its own sensor, or where that or the applied commands are not finite."""
    predictor, truth = made(), lbt.Truth(turbulence=None, noise_nm=1.0)
    written = lbt.interop.export(tmp_path / "p.c", predictor, "c", precision=precision)
    assert "residual with any sensors missing, loss" in [check.name for check in written.checks]
    spans = {"a": (0.1, 0.18), "b": (0.16, 0.24), "c": (0.4, 0.402)}
    drops = [Drop(unit=unit, start_s=start, end_s=end) for unit, (start, end) in spans.items()]
    limit, single = LIMITS[precision], precision == "single"
    compiled = require_commands(predictor, truth, drops, written, limit, single=single)
    before, state = compiled.u.copy(), compiled.state.copy()
    for y, fresh, applied in (
        (np.ones(5), [0, 1, 1, 1], np.zeros(2)),
        ([np.nan, *np.ones(4)], [1, 1, 1, 1], np.zeros(2)),
        (np.ones(5), [1, 1, 1, 1], [0.0, np.inf]),
    ):
        assert np.array_equal(compiled.step(y, fresh, applied), before)
        assert compiled.status == HELD
        assert np.array_equal(compiled.state, state)


CPP = """
#include "{0}"
#include "{0}"
int main() {{ {1}_state s; float y[{2}_MEASUREMENTS] = {{0}}, u[{2}_COMMANDS] = {{0}};
{3}{1}_reset(&s); {1}_step(&s, y, {4}u); return u[0] == 0.0f ? 0 : 1; }}
"""


def test_the_headers_are_fit_for_cpp(tmp_path, exported, sensor_files):
    fresh = "unsigned char fresh[SINGLE_SENSORS] = {0}; fresh[SINGLE_SENSOR_M1] = 1;\n"
    for source, more, inputs in (
        (exported("kalman", precision="single").files[0], "", ""),
        (sensor_files["single"].files[0], fresh, "fresh, u, "),
    ):
        name, user = source.stem, tmp_path / f"{source.stem}.cpp"
        header = source.with_suffix(".h")
        user.write_text(CPP.format(header, name, name.upper(), more, inputs))
        built, program = tmp_path / f"{name}.o", tmp_path / name
        subprocess.run([compiler(), *STRICT, "-c", source, "-o", built], check=True)
        strict = ["-std=c++98", "-pedantic", "-Wall", "-Wextra", "-Werror"]
        subprocess.run([compiler("c++"), *strict, user, built, "-o", program], check=True)
        subprocess.run([program], check=True)


def test_flags_that_hide_what_is_not_finite_are_refused(tmp_path, exported, sensor_files):
    for written in (exported("integrator"), sensor_files["double"]):
        command = [compiler(), *STRICT, "-ffast-math", "-c", written.files[0]]
        done = subprocess.run([*command, "-o", tmp_path / "k.o"], capture_output=True, text=True)
        assert done.returncode != 0
        assert "compile without -ffast-math" in done.stderr
