"""The terms of exported C source: of a design, in a run, counted, proved, read from the text."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.compiled import Compiled
from support.exports import bare_design, lbt_designs

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.interop.c.terms import RunningSource, as_computed, read_source, source_terms
from lbt_synth.interop.proof import prove_written, rehearsal_error
from lbt_synth.linear import estimator_form

KINDS = {"double": np.float64, "single": np.float32}


def export(folder, design, **options):
    return lbt.interop.export(folder / "ctl.c", design, "c", form="estimator", **options)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Function that exports a design in a precision, each of them once."""

    @cache
    def write(name, precision="double"):
        folder = tmp_path_factory.mktemp("exported")
        return export(folder, lbt_designs()[name], precision=precision)

    return write


@pytest.mark.parametrize("precision", KINDS)
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "turned"])
def test_the_source_is_what_was_proved(exported, designs, name, precision):
    design = designs[name]
    written = exported(name, precision)
    theirs = Compiled(written.files[0], single=precision == "single")
    assert rehearsal_error(design, theirs) == written.error
    names = [check.name for check in written.checks]
    assert names[0].startswith("spectral radius at sensor gains")
    assert names[-1] == "spectral radius of the estimator alone"
    assert all(check.passed for check in written.checks)
    beside = json.loads(written.files[2].read_text())
    assert (beside["form"], beside["precision"]) == ("estimator", precision)
    form = estimator_form(design)
    found = read_source(written.files[0].read_text(), source_terms(design, form="estimator"))
    n, kind = len(form.A), KINDS[precision]
    exact = np.hstack([form.A, form.applied]).astype(kind)
    assert np.array_equal(found.transition[0], exact)
    assert np.array_equal(found.gains[frozenset()][0], form.B.astype(kind))
    assert np.array_equal(found.command[:, :n], form.C.astype(kind))
    assert not found.command[:, n:].any()


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_it_takes_the_applied_commands(exported, designs, name):
    theirs = Compiled(exported(name).files[0])
    ours = estimator_form(designs[name]).start()
    rng = np.random.default_rng(2)
    for y, applied in rng.standard_normal((300, 2, 2)):
        expected = ours.step(y, applied)
        assert np.allclose(theirs.step(y, applied), expected, rtol=0, atol=1e-10)
        both = y.copy()  # one array for all: nothing is written before it is read
    expected = ours.step(both, both)
    theirs._call("step", theirs.state, both, both, both)
    assert np.allclose(both, expected, rtol=0, atol=1e-10)


def test_a_filter_without_a_loop_has_no_such_form(tmp_path):
    lag = lbt.Controller(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    with pytest.raises(lbt.errors.ProblemError, match="needs the design of a loop"):
        export(tmp_path, bare_design(lag))
    with pytest.raises(lbt.errors.ProblemError, match="form must be one of plain, estimator"):
        lbt.interop.export(tmp_path / "k.c", bare_design(lag), "c", form="observer")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def terms(sensors_design):
    return source_terms(sensors_design)


def test_the_terms_make_the_controllers_of_the_design(sensors_design, terms):
    assert terms.gains.keys() == sensors_design.controllers.keys()
    for missing, own in sensors_design.controllers.items():
        found = terms.controller(missing)
        for name in "ABCD":
            theirs = getattr(own, name)
            assert np.allclose(getattr(found, name), theirs, rtol=1e-12, atol=1e-12)


def test_single_precision_is_that_of_the_source(terms):
    rounded = terms.rounded()
    for name in ("transition", "innovation", "command"):
        exact, found = getattr(terms, name), getattr(rounded, name)
        assert np.array_equal(found, exact.astype(np.float32))
    assert np.any(rounded.transition != terms.transition)
    for missing, gains in terms.gains.items():
        assert np.array_equal(rounded.gains[missing], gains.astype(np.float32))
    with pytest.raises(ProblemError, match=r"single precision; got 1e\+39"):
        replace(terms, gains={frozenset(): np.full((2, 1, 6), 1e39)}).rounded()


def test_the_proof_is_of_the_loop_around_the_terms(sensors_design, terms):
    """Stable alone, too: what is left of the state where neither readings nor commands come."""
    checks = {
        check.name: check
        for check in prove_written(sensors_design, as_computed(sensors_design, terms))
    }
    assert len(checks) == 5
    assert all(check.passed for check in checks.values())
    loop = lbt.close_loop(sensors_design.hardware, sensors_design)
    radius = checks["spectral radius with all sensors"].value
    assert radius == pytest.approx(loop.system.radius_per_frame, rel=1e-9)
    certified = next(c for c in sensors_design.certificate.checks if "any loop" in c.name)
    worst = checks["spectral radius with any sensors missing"].value
    assert worst == pytest.approx(certified.value, rel=1e-9)


@pytest.mark.parametrize(
    ("missing", "factor", "failed"),
    [
        (frozenset(), 1.05, ["residual with all sensors, loss"]),
        (frozenset({"m1"}), 1.3, ["residual with any sensors missing, loss"]),
        (
            frozenset({"m1"}),
            6.0,
            ["spectral radius with any sensors missing", "residual with any sensors missing, loss"],
        ),
    ],
)
def test_other_gains_fail(sensors_design, terms, missing, factor, failed):
    gains = {some: own * (factor if some == missing else 1) for some, own in terms.gains.items()}
    checks = prove_written(sensors_design, as_computed(sensors_design, replace(terms, gains=gains)))
    assert set(failed) <= {check.name for check in checks if not check.passed}
    others = "any sensors missing" if not missing else "all sensors"
    assert all(check.passed for check in checks if others in check.name)


@pytest.mark.usefixtures("short_rehearsal")
def test_the_rehearsal_sees_each_filter(sensors_design, terms):
    assert rehearsal_error(sensors_design, RunningSource(terms)) < 1e-11
    for missing in [(), ("wavefront",), ("slow",), ("m1",), ("m2",)]:
        gains = dict(terms.gains)
        gains[frozenset(missing)] = 1.01 * gains[frozenset(missing)]
        off = rehearsal_error(sensors_design, RunningSource(replace(terms, gains=gains)))
        assert off > 1e-7
    huge = replace(terms, command=terms.command * 1e37, single=True)
    assert rehearsal_error(sensors_design, RunningSource(huge)) == np.inf


def test_costs_by_hand():
    controller = lbt.Controller(
        A=[[1.0, 0.5], [0.0, -1.0]], B=[[2.0], [0.0]], C=[[1.0, 1.0], [0.0, 0.0]], D=[[0.0], [3.0]]
    )
    cost = frame_cost(controller)
    # x0 + .5 x1 + 2 y; -x1; n0 + n1; 3 y
    assert (cost.multiplications, cost.additions) == (3, 3)


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_costs_are_those_of_the_source(tmp_path, designs, name):
    text = lbt.interop.export(tmp_path / "k.c", designs[name], "c").files[0].read_text()
    body = text.split("k_step(k_state", 1)[1].split("{", 1)[1]
    cost = frame_cost(designs[name])
    assert body.count(" * ") == cost.multiplications
    assert body.count(" + ") + body.count(" - ") == cost.additions


def test_more_terms_than_a_compiler_takes_are_refused(tmp_path):
    n = 320
    full = lbt.Controller(A=np.eye(n) / 2 + 1e-5, B=np.ones((n, 1)), C=np.ones((1, n)), D=[[0.0]])
    with pytest.raises(ProblemError, match="at most 100,000 numbers in C; got 103,040"):
        lbt.interop.export(tmp_path / "k.c", bare_design(full), "c")
