"""Exported C source of several sensors, compiled and run beside the simulation of its loop."""

import json
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from support.compiled import STRICT, CompiledFilter, compiler, header_numbers
from support.exports import relative

import lbt_synth as lbt
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.interop.c import masked_export
from lbt_synth.interop.c.masked_terms import MaskedSource, masked_terms
from lbt_synth.interop.target import target_named, target_names
from lbt_synth.loop.simulation.failing_sensors import Drop, simulate_sensors

FRAMES = 1200
DROPS = (
    Drop(unit="m1", start_s=0.1, end_s=0.301),
    Drop(unit="slow", start_s=0.2, end_s=0.5),
    Drop(unit="wavefront", start_s=0.25, end_s=0.3),
    Drop(unit="m2", start_s=0.901),
)
UNITS = ("wavefront", "slow", "m1", "m2")
MISSING, NOT_FINITE, NOT_DUE, NOT_APPLIED = 1, 2, 4, 8


@pytest.fixture(scope="module")
def written(sensors_design, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masked_c")
    return {
        precision: lbt.interop.export_c(
            folder / f"{precision}.c", sensors_design, precision=precision
        )
        for precision in ("double", "single")
    }


@pytest.fixture
def theirs(written):
    return CompiledFilter(written["double"].files[0])


def run(sensors_design, config, filters):
    """A run in which sensors fail, alone and together; its readings and commands."""
    return simulate_sensors(
        filters,
        config.truth,
        hardware=sensors_design.hardware,
        frames=FRAMES,
        settle_frames=0,
        drops=DROPS,
    )


@pytest.fixture(scope="module")
def simulated(sensors_design, sensors_config):
    """That run with the filters of the design."""
    return run(sensors_design, sensors_config, sensors_design.controllers)


def fresh_in(k, missing=None):
    """What is new in a frame: the slow sensor is read in every second one."""
    away = {d.unit for d in DROPS if d.covers(k * 1e-3 + 1e-9)} if missing is None else missing
    return [unit not in away and not (unit == "slow" and k % 2) for unit in UNITS]


def test_the_commands_are_those_of_the_simulation(simulated, theirs):
    """On the same readings and applied commands, with sensors missing."""
    last, found = np.zeros(2), []
    for k, (y, u) in enumerate(zip(simulated.measurements[0], simulated.commands[0], strict=True)):
        fresh = fresh_in(k)
        stale = np.where(np.repeat(fresh, [2, 2, 1, 1]), y, np.nan)  # nobody looks at the others
        found.append(theirs.step(stale, fresh, last))
        assert theirs.status == MISSING * any(d.covers(k * 1e-3 + 1e-9) for d in DROPS)
        last = u
    assert relative(found, simulated.commands[0]) < 1e-9


@pytest.mark.parametrize(("precision", "limit"), [("double", 1e-9), ("single", 1e-3)])
def test_the_compiled_filter_closes_the_loop(
    sensors_design, sensors_config, simulated, written, precision, limit
):
    """The simulation with the compiled source as its filters, for each set that is missing."""
    theirs = CompiledFilter(written[precision].files[0], single=precision == "single")
    frame = iter(range(FRAMES))

    class Stepped:
        """What a filter multiplies its new state by, which is y, to get the commands."""

        def __init__(self, missing):
            self.missing = missing

        def __matmul__(self, y):
            return theirs.step(y[:, 0], fresh_in(next(frame), self.missing), theirs.u)[:, None]

    class Filter:
        n_states = sensors_design.problem.n_measurements

        def __init__(self, missing):
            self.missing = missing

        def stacks(self):
            A, B, D = np.zeros((2, 6, 6)), np.tile(np.eye(6), (2, 1, 1)), np.zeros((2, 2, 6))
            return A, B, [Stepped(self.missing)] * 2, D

    filters = {some: Filter(some) for some in sensors_design.controllers}
    found = run(sensors_design, sensors_config, filters)
    assert relative(found.commands, simulated.commands) < limit
    assert relative(found.residual_nm, simulated.residual_nm) < limit


@pytest.mark.parametrize("precision", ["double", "single"])
def test_the_rehearsal_is_the_arithmetic_of_the_source(sensors_design, written, precision):
    """Bit for bit, with what is new drawn at random."""
    single = precision == "single"
    theirs = CompiledFilter(written[precision].files[0], single=single)
    ours = written[precision].start(np.inf)
    rng = np.random.default_rng(0)
    for k in range(300):
        y, applied = rng.standard_normal(6), rng.standard_normal(2)
        fresh = (rng.random(4) < 0.8) & fresh_in(k, ())
        given = dict(zip(UNITS, fresh, strict=True))
        assert np.array_equal(theirs.step(y, fresh, applied), ours.step(y, given, applied))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_reading_that_is_not_finite_is_not_fresh(theirs, written, bad):
    other = CompiledFilter(written["double"].files[0])
    for k, y in enumerate(np.random.default_rng(1).standard_normal((20, 6))):
        fresh, without = fresh_in(k, ()), fresh_in(k, ("wavefront", "m2"))
        expected = other.step(y, without, other.u)
        y[[1, 5]] = bad
        assert np.array_equal(theirs.step(y, fresh, theirs.u), expected)
        assert theirs.status == MISSING | NOT_FINITE
        assert other.status == MISSING
        assert np.array_equal(theirs.state, other.state)


def test_a_sensor_that_is_not_due_is_not_read(theirs, written):
    other = CompiledFilter(written["double"].files[0])
    for k, y in enumerate(np.random.default_rng(2).standard_normal((20, 6))):
        expected = other.step(y, fresh_in(k, ()), other.u)
        assert np.array_equal(theirs.step(y, [1, 1, 1, 1], theirs.u), expected)
        assert theirs.status == NOT_DUE * (k % 2)
        assert other.status == 0


def test_a_slip_of_the_phase_is_seen_and_mended(theirs, written):
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


def test_commands_that_are_not_finite_are_taken_for_the_last_ones(theirs, written):
    other = CompiledFilter(written["double"].files[0])
    for k, y in enumerate(np.random.default_rng(3).standard_normal((10, 6))):
        expected = other.step(y, fresh_in(k, ()), other.u)
        assert np.array_equal(theirs.step(y, fresh_in(k, ()), [theirs.u[0], np.nan]), expected)
        assert theirs.status == NOT_APPLIED
    assert np.any(theirs.u)


def test_reset_forgets(theirs):
    series = np.random.default_rng(4).standard_normal((9, 6))
    runs = []
    for _ in range(2):
        theirs.reset()
        runs.append([theirs.step(y, fresh_in(k, ()), y[:2]) for k, y in enumerate(series)])
        theirs.step(series[0], [0, 0, 0, 0], [5.0, 5.0])
    assert np.array_equal(*runs)


def renamed(sensors_design, names):
    """The design with other names of its sensor and channels."""
    sensors = sensors_design.problem.hardware.suite.sensors
    slow, mirror = replace(sensors[0], name=names[0]), replace(sensors[1], channels=names[1:])
    suite = lbt.models.SensorSuite(sensors=(slow, mirror))
    place = dict(zip(sensors[1].channels, names[1:], strict=True))
    motions = tuple({place[c]: m for c, m in own.items()} for own in sensors_design.problem.motions)
    return lbt.kalman(sensors_design.problem.own_sensor_alone().with_sensors(suite, motions))


@pytest.mark.usefixtures("short_rehearsal")
@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("slow one", "2nd", "m*/"), ["WAVEFRONT", "SLOW_ONE", "2ND", "M"]),
        (("m-1", "m_1", "ä"), ["WAVEFRONT_0", "M_1_1", "M_1_2", "3"]),
        (("x" * 30, "int", "\\\n*/"), ["WAVEFRONT_0", "X" * 24 + "_1", "INT_2", "3"]),
    ],
)
def test_names_of_sensors_that_are_no_identifiers(tmp_path, sensors_design, names, found):
    files = lbt.interop.export_c(tmp_path / "odd.c", renamed(sensors_design, names)).files
    header = files[1].read_text()
    assert re.findall(r"ODD_SENSOR_(\w+) = ", header) == found
    assert header.isascii()
    assert header.count("/*") == header.count("*/")
    CompiledFilter(files[0]).step(np.zeros(6), [1, 1, 1, 1], np.zeros(2))


def test_the_header_is_fit_for_cpp(tmp_path, written):
    user = tmp_path / "user.cpp"
    user.write_text(
        f'#include "{written["single"].files[1]}"\n'
        "int main() { single_state s; float y[SINGLE_MEASUREMENTS] = {0}, u[SINGLE_COMMANDS] = {0};"
        "unsigned char fresh[SINGLE_SENSORS] = {0}; fresh[SINGLE_SENSOR_M1] = 1;\n"
        "single_reset(&s); return single_step(&s, y, fresh, u, u); }\n"
    )
    flags = ["-std=c++98", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
    subprocess.run([compiler("c++"), *flags, user], check=True)


def test_what_has_no_source_is_refused(tmp_path, sensors_design):
    failed = lbt.design.Check("of a test", 1.0, 0.5, "hand")
    wrong = replace(
        sensors_design, certificate=replace(sensors_design.certificate, checks=(failed,))
    )
    for design, options, error, words in (
        (sensors_design, {"form": "plain"}, ProblemError, "in estimator form alone"),
        (sensors_design, {"name": "kal-man"}, ProblemError, "prefix of the C names must"),
        (wrong, {}, CertificateError, "of a test"),
    ):
        with pytest.raises(error, match=words):
            lbt.interop.export_c(tmp_path / "k.c", design, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("short_rehearsal")
def test_a_table_that_is_too_long_is_refused(tmp_path, sensors_design, monkeypatch):
    terms = masked_terms(sensors_design)
    count = sum(np.count_nonzero(gains.any(axis=1)) for gains in terms.gains.values())
    count *= sensors_design.problem.n_states
    monkeypatch.setattr(masked_export, "MOST_GAINS", count)
    lbt.interop.export_c(tmp_path / "k.c", sensors_design)
    monkeypatch.setattr(masked_export, "MOST_GAINS", count - 1)
    with pytest.raises(ProblemError, match=rf"got {count:,}, in a period of 2 frames"):
        lbt.interop.export_c(tmp_path / "long.c", sensors_design)


def test_commands_that_are_off_are_refused(tmp_path, sensors_design, monkeypatch):
    monkeypatch.setattr(masked_export, "_LARGEST_ERROR", 1e-9)
    lbt.interop.export_c(tmp_path / "k.c", sensors_design)
    with pytest.raises(NumericalError, match=r"in a rehearsal.*Try double precision"):
        lbt.interop.export_c(tmp_path / "single.c", sensors_design, precision="single")
    assert not list(tmp_path.glob("single*"))


@pytest.mark.parametrize("target", sorted({*target_names()} - {"c"}))
def test_other_targets_refuse_it(tmp_path, sensors_design, target):
    own = target_named(target)
    with pytest.raises(ProblemError, match="this design reads slow, m1, m2 beside"):
        own.write(own.path_in(tmp_path), sensors_design)
    assert not list(tmp_path.iterdir())


def test_the_certificate_beside_the_source(written):
    for precision, exported in written.items():
        beside = json.loads(exported.files[2].read_text())
        assert (beside["form"], beside["precision"]) == ("estimator", precision)
        assert (beside["period"], beside["sensors"]) == (2, list(UNITS))
        assert [check["passed"] for check in beside["checks"]] == [True] * 6
        assert beside["checks"][-1]["value"] == exported.error
    assert written["double"].error < 1e-11 < written["single"].error < 1e-3
    assert written["double"].error_single == written["single"].error


def test_the_cost_is_that_of_the_source(written):
    """Products of a frame in which all is read, and numbers, counted in the text."""
    text, cost = written["double"].files[0].read_text(), written["double"].cost
    sizes = header_numbers(written["double"].files[0], "double")
    constants, gains = (int(re.search(rf"real {a}\[(\d+)\]", text)[1]) for a in ("c", "gains"))
    varying = int(re.search(r"real varying\[DOUBLE_PERIOD\]\[(\d+)\]", text)[1])
    assert cost.coefficients == constants + 2 * varying + gains
    products = len(re.findall(r"[cv]\[\d+\] \*", text.split("int double_step")[1]))
    estimates = int(re.search(r"i < (\d+); i\+\+\) {\n +x\[i\]", text)[1])
    assert cost.multiplications == products + 6 * estimates
    assert cost.states == sizes["STATES"] + sizes["COMMANDS"]


def test_flags_that_hide_such_readings_are_refused(tmp_path, written):
    command = [compiler(), *STRICT, "-ffast-math", "-c", written["double"].files[0]]
    done = subprocess.run([*command, "-o", tmp_path / "k.o"], capture_output=True, text=True)
    assert "compile without -ffast-math" in done.stderr


def test_a_source_that_is_stepped_without_more_is_that_of_all_sensors(sensors_design):
    """What is due is new, and its own commands are applied: the controller of the design."""
    source, own = MaskedSource(masked_terms(sensors_design), np.float64), sensors_design.controller
    x = np.zeros(own.n_states)
    for k, y in enumerate(np.random.default_rng(5).standard_normal((30, 6))):
        x = own.A[k % 2] @ x + own.B[k % 2] @ y
        assert source.step(y) == pytest.approx(own.C[0] @ x, rel=1e-9)
