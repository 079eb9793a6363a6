"""The exported C source, compiled and run beside the controller."""

import json
import re
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.compiled import STRICT, Compiled, compiler
from support.exports import bare_design, lbt_designs, relative
from support.predictors import made
from support.refusals import require_refusals
from support.sensor_loops import SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.result import SolverReport
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop import pipeline, proof
from lbt_synth.interop.c import export as c_export
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.interop.c.terms import RunningSource, source_terms
from lbt_synth.interop.pipeline import target_named, target_names
from lbt_synth.interop.proof import rehearsal_error
from lbt_synth.loop.simulation import Drop

LIMITS = {"double": 1e-12, "single": 1e-5}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Function that writes ``ctl.c`` of a design and a precision, each of them once."""

    @cache
    def write(name, precision="double"):
        target = tmp_path_factory.mktemp("exported") / "ctl.c"
        return lbt.interop.export(target, lbt_designs()[name], "c", precision=precision)

    return write


@pytest.mark.parametrize("precision", LIMITS)
@pytest.mark.parametrize("name", ["kalman", "hinf", "turned"])
def test_the_rehearsal_is_the_arithmetic_of_the_source(exported, designs, name, precision):
    """Bit for bit in the loop, and the reported error is that of the compiled source."""
    design, single = designs[name], precision == "single"
    written = exported(name, precision)
    theirs = Compiled(written.files[0], single=single)
    assert rehearsal_error(design, theirs) == written.error
    assert 0 < written.error < LIMITS[precision]
    if single:
        assert written.error > 1e-9
    terms = source_terms(design)
    ours = RunningSource(terms.rounded() if single else terms)
    theirs.reset()
    for y in np.random.default_rng(6).standard_normal((50, 2)):
        assert np.array_equal(ours.step(y), theirs.step(y))


FORMS = [{"form": form, "precision": p} for form in ("plain", "estimator") for p in LIMITS]


@pytest.mark.parametrize("options", FORMS, ids=lambda options: "-".join(options.values()))
@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_what_is_not_finite_holds_command_and_state(tmp_path, designs, name, options):
    """In arrays of their own, and where commands share one with the measurements."""
    source = lbt.interop.export(tmp_path / "ctl.c", designs[name], "c", **options).files[0]
    theirs, clean = (Compiled(source, single=options["precision"] == "single") for _ in range(2))
    before, more = np.zeros(2), options["form"] == "estimator"
    for y in np.random.default_rng(4).standard_normal((20, 2)):
        for bad in (np.nan, np.inf, -np.inf):
            state = theirs.state.copy()
            for place in range(2 + 2 * more):
                inputs = np.ones(2 + 2 * more)
                inputs[place] = bad
                theirs.u[:] = 99.0
                assert np.array_equal(theirs.step(*inputs.reshape(-1, 2)), before)
                assert theirs.status == 1
                assert np.array_equal(theirs.state, state)
        given = [y, before][: 1 + more]
        both = np.array([np.nan, 1.0], dtype=theirs.real)
        theirs._call("step", theirs.state, *[both] * (2 + more))
        assert np.array_equal(both, before)
        before = clean.step(*given)
        assert np.array_equal(theirs.step(*given), before)
        assert theirs.status == clean.status == 0


@pytest.mark.parametrize("name", ["kalman", "turned", "sensors"])
def test_reset_forgets(exported, sensor_files, name):
    files = sensor_files["double"].files if name == "sensors" else exported(name).files
    theirs, sensors = Compiled(files[0]), name == "sensors"
    series = np.random.default_rng(4).standard_normal((20, 6 if sensors else 2))
    runs = []
    for _ in range(2):
        theirs.reset()
        more = [[fresh_in(k, ()), y[:2]] if sensors else [] for k, y in enumerate(series)]
        runs.append([theirs.step(y, *given) for y, given in zip(series, more, strict=True)])
        theirs.step(series[0], *([[0, 0, 0, 0], [5.0, 5.0]] if sensors else []))
    assert np.array_equal(*runs)
    theirs.reset()
    if not sensors:
        assert np.array_equal(theirs.step([np.nan, 1.0]), [0.0, 0.0])


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


@pytest.mark.usefixtures("short_rehearsal")
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(controller=controllers(), precision=st.sampled_from(list(LIMITS)))
def test_any_stable_controller(tmp_path, controller, precision):
    written = lbt.interop.export(
        tmp_path / "any.c", bare_design(controller), "c", precision=precision
    )
    theirs = Compiled(written.files[0], single=precision == "single")
    ours = controller.start()
    series = np.random.default_rng(2).standard_normal((200, controller.B.shape[1]))
    expected = np.array([ours.step(y) for y in series])
    found = np.array([theirs.step(y) for y in series])
    states = max(1.0, float(np.max(np.abs(ours.state))))
    size = max(float(np.max(np.abs(expected))), states)
    assert np.max(np.abs(found - expected)) < LIMITS[precision] * size


def test_coefficients_are_exact_and_explained(exported, designs):
    controller = designs["kalman"].controller
    text = exported("kalman").files[0].read_text()
    found = re.findall(r"(-?0x\S+p[+-]\d+), /\* ([ABCD])\[(\d+)\]\[(\d+)\] = (\S+) \*/", text)
    matrices = (np.abs(getattr(controller, name)) for name in "ABCD")
    assert len(found) == sum(np.sum((matrix > 0) & (matrix != 1)) for matrix in matrices)
    for code, name, i, j, decimal in found:
        value = getattr(controller, name)[int(i), int(j)]
        assert float.fromhex(code) == value == float(decimal)


def test_the_comment_says_where_it_comes_from(tmp_path, designs):
    sha = "ab" * 32
    written = lbt.interop.export(tmp_path / "k.c", designs["kalman"], "c", gain_digest=sha)
    for file in written.files[:2]:
        text = file.read_text()
        for part in (lbt.__version__, "kalman (riccati)", sha, "800.0 Hz", "2.0 frames", "nm rms"):
            assert part in text
        assert f"{len(designs['kalman'].certificate.checks)} checks passed" in text
    assert f'#define K_GAIN_SHA256 "{sha}"' in written.files[1].read_text()


EVIL = '*/ int main(void) {} /* x\\\n*/ ??/ *\n/ #error \u202e*/ a"b \x00'


@pytest.mark.usefixtures("short_rehearsal")
def test_words_cannot_leave_the_comment(tmp_path, designs):
    check = lbt.design.Check(name=EVIL, value=0.0, limit=1.0, computed_by=EVIL)
    design = replace(
        designs["integrator"],
        method=EVIL,
        solver=SolverReport(route=EVIL, status=EVIL),
        certificate=lbt.design.Certificate(
            checks=(check,), gamma=np.nan, rms_per_output=np.zeros(0)
        ),
    )
    source = lbt.interop.export(tmp_path / "tip-tilt.v2.c", design, "c", name="Tip_tilt2").files[0]
    Compiled(source, name="Tip_tilt2")
    code = source.read_text()
    assert '#include "tip-tilt.v2.h"' in code
    assert code.isascii()
    assert code.count("*/") == code.count("/*")
    assert "main" not in code.split("*/", 1)[1]


@pytest.mark.usefixtures("short_rehearsal")
def test_what_has_no_source_is_refused(tmp_path, designs, sensors_design):
    def write(file="k.c", design=designs["integrator"], **options):
        return lambda: lbt.interop.export(tmp_path / file, design, "c", **options)

    names = ("", "2fast", "a b", "_x", "a__b", "ä", "x" * 26, 3, "a\n")
    prefix = "prefix of the C names must"
    rows = [(write(name=name), ProblemError, prefix) for name in names]
    ending = lbt.errors.OutputError, r"must end in \.c"
    rows += [(write(file, name="k"), *ending) for file in ("k.h", 'k".c', "..")]
    rows += [
        (write(design=sensors_design, form="plain"), ProblemError, "in estimator form alone"),
        (write(precision="half"), ProblemError, "must be one of double, single"),
    ]
    require_refusals(rows)
    assert not list(tmp_path.iterdir())


def test_arithmetic_that_overflows_is_refused(tmp_path):
    """Coefficients that fit, products that do not."""
    steep = lbt.Controller(A=[[0.5]], B=[[1e30]], C=[[1e30]], D=[[0.0]])
    lbt.interop.export(tmp_path / "k.c", bare_design(steep), "c")
    with pytest.raises(lbt.errors.NumericalError, match=r"\(single precision\); the commands grow"):
        lbt.interop.export(tmp_path / "single.c", bare_design(steep), "c", precision="single")
    assert not list(tmp_path.glob("single*"))


def test_a_loop_that_rounding_would_break_is_refused(tmp_path, loaded):
    brink = lbt.integrator(loaded.hardware, gain=1 - 1e-8)  # stable below 1; rounds to 1
    lbt.interop.export(tmp_path / "k.c", brink, "c")
    with pytest.raises(
        lbt.errors.NumericalError, match="what its design promises .* spectral radius"
    ):
        lbt.interop.export(tmp_path / "single.c", brink, "c", precision="single")
    assert not list(tmp_path.glob("single*"))


SENSOR_FRAMES = 1200
DROPS = (
    Drop(unit="m1", start_s=0.1, end_s=0.301),
    Drop(unit="slow", start_s=0.2, end_s=0.5),
    Drop(unit="wavefront", start_s=0.25, end_s=0.3),
    Drop(unit="m2", start_s=0.901),
)
UNITS = ("wavefront", "slow", "m1", "m2")
MISSING, NOT_FINITE, NOT_DUE, NOT_APPLIED = 1, 2, 4, 8
HELD = 2  # of a predictor


@pytest.fixture(scope="module")
def sensor_files(sensors_design, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masked_c")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "FRAMES", 500)
        return {
            precision: lbt.interop.export(
                folder / f"{precision}.c", sensors_design, "c", precision=precision
            )
            for precision in LIMITS
        }


@pytest.fixture
def theirs(sensor_files):
    return Compiled(sensor_files["double"].files[0])


def test_the_header_says_where_each_sensor_reads(tmp_path):
    design = lbt.kalman(example_plant((SLOW,)))
    header = lbt.interop.export(tmp_path / "k.c", design, "c").files[1].read_text()
    assert "fresh[0]     wavefront: y[0] to y[1], every frame\n" in header
    assert "fresh[1]     truth: y[2] to y[3], every 4 frames\n" in header


def run_sensors(controller, config, hardware):
    """A run in which sensors fail, alone and together; its readings and commands."""
    return lbt.simulate(
        controller,
        config.truth,
        hardware=hardware,
        frames=SENSOR_FRAMES,
        settle_frames=0,
        drops=DROPS,
    )


@pytest.fixture(scope="module")
def simulated(sensors_design, sensors_config):
    """That run with the filters of the design."""
    return run_sensors(sensors_design, sensors_config, sensors_design.hardware)


def is_away(drop, k):
    """Whether a sensor is missing in a frame."""
    return drop.start_s <= k * 1e-3 + 1e-9 < drop.end_s


def fresh_in(k, missing=None):
    """What is new in a frame: the slow sensor is read in every second one."""
    away = {drop.unit for drop in DROPS if is_away(drop, k)} if missing is None else missing
    return [unit not in away and not (unit == "slow" and k % 2) for unit in UNITS]


def test_the_commands_are_those_of_the_simulation(simulated, theirs):
    """On the same readings and applied commands, with sensors missing."""
    last, found = np.zeros(2), []
    for k, (y, u) in enumerate(zip(simulated.measurements[0], simulated.commands[0], strict=True)):
        fresh = fresh_in(k)
        stale = np.where(np.repeat(fresh, [2, 2, 1, 1]), y, np.nan)  # nobody looks at the others
        found.append(theirs.step(stale, fresh, last))
        assert theirs.status == MISSING * any(is_away(drop, k) for drop in DROPS)
        last = u
    assert relative(found, simulated.commands[0]) < 1e-9


@pytest.mark.parametrize("precision", ["double", "single"])
def test_with_sensors_missing_it_is_that_arithmetic(sensors_design, sensor_files, precision):
    """Bit for bit, with what is new drawn at random."""
    single = precision == "single"
    theirs = Compiled(sensor_files[precision].files[0], single=single)
    ours = sensor_files[precision].start(np.inf)
    rng = np.random.default_rng(0)
    for k in range(300):
        y, applied = rng.standard_normal(6), rng.standard_normal(2)
        fresh = (rng.random(4) < 0.8) & fresh_in(k, ())
        given = dict(zip(UNITS, fresh, strict=True))
        assert np.array_equal(theirs.step(y, fresh, applied), ours.step(y, given, applied))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_reading_that_is_not_finite_is_not_fresh(theirs, sensor_files, bad):
    other = Compiled(sensor_files["double"].files[0])
    for k, y in enumerate(np.random.default_rng(1).standard_normal((20, 6))):
        fresh, without = fresh_in(k, ()), fresh_in(k, ("wavefront", "m2"))
        expected = other.step(y, without, other.u)
        y[[1, 5]] = bad
        assert np.array_equal(theirs.step(y, fresh, theirs.u), expected)
        assert theirs.status == MISSING | NOT_FINITE
        assert other.status == MISSING
        assert np.array_equal(theirs.state, other.state)


def test_a_sensor_that_is_not_due_is_not_read(theirs, sensor_files):
    other = Compiled(sensor_files["double"].files[0])
    for k, y in enumerate(np.random.default_rng(2).standard_normal((20, 6))):
        expected = other.step(y, fresh_in(k, ()), other.u)
        assert np.array_equal(theirs.step(y, [1, 1, 1, 1], theirs.u), expected)
        assert theirs.status == NOT_DUE * (k % 2)
        assert other.status == 0


def test_a_slip_of_the_phase_is_seen_and_mended(theirs, sensor_files):
    """The slow sensor is missing from a frame in which it is due until it is read again."""
    seen = []
    for k in range(8):
        if k == 5:
            theirs.phase(10_001)  # of an odd number of frames
        theirs.step(np.zeros(6), [1, (k + 1) % 2 == 0, 1, 1], np.zeros(2))
        seen.append(theirs.status)
    slipped = [MISSING, MISSING | NOT_DUE]
    assert seen[:5] == [*slipped, *slipped, MISSING]
    assert seen[5:] == [MISSING | NOT_DUE, MISSING, MISSING | NOT_DUE]
    theirs.phase(0)
    theirs.step(np.zeros(6), [1, 1, 1, 1], np.zeros(2))
    assert theirs.status == 0


def test_commands_that_are_not_finite_are_taken_for_the_last_ones(theirs, sensor_files):
    other = Compiled(sensor_files["double"].files[0])
    for k, y in enumerate(np.random.default_rng(3).standard_normal((10, 6))):
        expected = other.step(y, fresh_in(k, ()), other.u)
        assert np.array_equal(theirs.step(y, fresh_in(k, ()), [theirs.u[0], np.nan]), expected)
        assert theirs.status == NOT_APPLIED
    assert np.any(theirs.u)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("slow one", "2nd", "m*/"), ["WAVEFRONT", "SLOW_ONE", "2ND", "M"]),
        (("m-1", "m_1", "ä"), ["WAVEFRONT_0", "M_1_1", "M_1_2", "3"]),
        (("x" * 30, "int", "\\\n*/"), ["WAVEFRONT_0", "X" * 24 + "_1", "INT_2", "3"]),
    ],
)
def test_names_of_sensors_that_are_no_identifiers(sensors_design, names, found):
    terms = source_terms(sensors_design)
    rows = dict(zip(("wavefront", *names), terms.rows.values(), strict=True))
    units = c_export._describe_units(replace(terms, rows=rows))
    assert [unit["identifier"] for unit in units] == found
    assert all(unit["name"].isascii() and "*/" not in unit["name"] for unit in units)


@pytest.mark.usefixtures("short_rehearsal")
def test_a_table_that_is_too_long_is_refused(tmp_path, sensors_design, monkeypatch):
    terms = source_terms(sensors_design)
    count = sum(np.count_nonzero(gains.any(axis=1)) for gains in terms.gains.values())
    count *= sensors_design.problem.n_states
    monkeypatch.setattr(c_export, "MOST_GAINS", count)
    lbt.interop.export(tmp_path / "k.c", sensors_design, "c")
    monkeypatch.setattr(c_export, "MOST_GAINS", count - 1)
    with pytest.raises(ProblemError, match=rf"got {count:,}, in a period of 2 frames"):
        lbt.interop.export(tmp_path / "long.c", sensors_design, "c")


@pytest.mark.usefixtures("short_rehearsal")
def test_commands_that_are_off_are_refused(tmp_path, sensors_design, monkeypatch):
    monkeypatch.setattr(pipeline, "LOSS", 1e-9)  # single precision is off by more
    with pytest.raises(NumericalError, match=r"in a rehearsal.*Try double precision"):
        lbt.interop.export(tmp_path / "single.c", sensors_design, "c", precision="single")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("target", sorted({*target_names()} - {"c"}))
def test_other_targets_refuse_it(tmp_path, sensors_design, target):
    own = target_named(target)
    with pytest.raises(ProblemError, match="this design reads slow, m1, m2 beside"):
        lbt.interop.export(own.path_in(tmp_path), sensors_design, target)
    assert not list(tmp_path.iterdir())


def test_the_certificate_beside_the_source(sensor_files):
    for precision, exported in sensor_files.items():
        beside = json.loads(exported.files[2].read_text())
        assert (beside["form"], beside["precision"]) == ("estimator", precision)
        assert (beside["period"], beside["sensors"]) == (2, list(UNITS))
        assert [check["passed"] for check in beside["checks"]] == [True] * 6
        assert beside["checks"][-1]["value"] == exported.error
    assert sensor_files["double"].error < 1e-11 < sensor_files["single"].error < 1e-3


def test_the_cost_is_that_of_the_source(sensor_files, sensors_design):
    """Products and sums of a frame in which all is read, counted in the text."""
    text = sensor_files["double"].files[0].read_text().split("int double_step")[1]
    written, cost = (
        "".join(re.findall(r"=\n([^;]*);", text)),
        frame_cost(source_terms(sensors_design)),
    )
    gains = 6 * int(re.search(r"add\(state->x, (\d+), gains", text)[1])
    assert cost.multiplications == written.count(" * ") + gains
    assert cost.additions == written.count(" + ") + written.count(" - ") + gains


@pytest.mark.parametrize("precision", LIMITS)
def test_a_predictor_without_a_channel_is_its_fall_back(tmp_path, precision):
    """In the loop of its own commands, beside the controllers of the design."""
    predictor = made()
    written = lbt.interop.export(tmp_path / "p.c", predictor, "c", precision=precision)
    theirs = Compiled(written.files[0], single=precision == "single")
    twin, ours = written.start(np.inf), predictor.controller.start(predictor.controllers)
    rng, commands = np.random.default_rng(0), np.zeros((2, 2, 2))  # of both loops
    expected, found = [], []
    for k in range(300):
        y = rng.standard_normal(5)
        fresh = np.array([True, not 50 <= k < 90, not 80 <= k < 120, k != 200])
        ours.miss([unit for unit, read in zip("abc", fresh[1:], strict=True) if not read])
        seen = [np.append(y[:2] - past[1], y[2:]) for past in commands]
        expected.append(ours.step(seen[0]))
        last = theirs.u.astype(float)
        blind = np.where(np.repeat(fresh, [2, 1, 1, 1]), seen[1], np.nan)
        found.append(theirs.step(blind, fresh, last))
        new = dict(zip(("wavefront", *"abc"), fresh.tolist(), strict=True))
        assert np.array_equal(found[-1], twin.step(blind, new, last))
        assert theirs.status == (MISSING if not fresh.all() else 0)
        commands = np.stack([np.stack([expected[-1], found[-1]]), commands[:, 0]], axis=1)
    assert relative(found, expected) < LIMITS[precision]
    names = [check.name for check in written.checks]
    assert "residual with any sensors missing, loss" in names
    before, state = theirs.u.copy(), theirs.state.copy()
    for y, fresh, applied in (
        (np.ones(5), [0, 1, 1, 1], np.zeros(2)),
        ([np.nan, *np.ones(4)], [1, 1, 1, 1], np.zeros(2)),
        (np.ones(5), [1, 1, 1, 1], [0.0, np.inf]),
    ):
        assert np.array_equal(theirs.step(y, fresh, applied), before)
        assert theirs.status == HELD
        assert np.array_equal(theirs.state, state)


CPP = """
#include "{0}"
#include "{0}"
int main() {{ {1}_state s; float y[{2}_MEASUREMENTS] = {{0}}, u[{2}_COMMANDS] = {{0}};
{3}{1}_reset(&s); {1}_step(&s, y, {4}u); return u[0] == 0.0f ? 0 : 1; }}
"""


def test_the_headers_are_fit_for_cpp(tmp_path, exported, sensor_files):
    fresh = "unsigned char fresh[SINGLE_SENSORS] = {0}; fresh[SINGLE_SENSOR_M1] = 1;\n"
    for source, more, inputs in (
        (exported("kalman", "single").files[0], "", ""),
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
