"""The estimator form of the exported C source, compiled and run."""

import json
from functools import cache

import numpy as np
import pytest
from support.compiled import Compiled
from support.exports import bare_design, lbt_designs

import lbt_synth as lbt
from lbt_synth.interop.c.arithmetic import read_source
from lbt_synth.interop.export_checks import rehearsal_error
from lbt_synth.linear import estimator_form

KINDS = {"double": np.float64, "single": np.float32}


class Applied:
    """The compiled source, given its own commands as those that were applied."""

    def __init__(self, compiled):
        self.compiled = compiled

    def reset(self):
        self.compiled.reset()

    def step(self, y):
        return self.compiled.step(y, self.compiled.u)


def export(folder, design, **options):
    return lbt.interop.export_c(folder / "ctl.c", design, form="estimator", **options)


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
    assert rehearsal_error(design, Applied(theirs)) == written.error
    names = [check.name for check in written.checks]
    assert names[0] == "spectral radius of the estimator alone"
    assert names[1].startswith("spectral radius at sensor gains")
    assert all(check.passed for check in written.checks)
    beside = json.loads(written.files[2].read_text())
    assert (beside["form"], beside["precision"]) == ("estimator", precision)
    form = estimator_form(design)
    states, commands = read_source(*(file.read_text() for file in written.files[:2]))
    exact = np.hstack([form.A, form.B, form.applied]).astype(KINDS[precision])
    assert np.array_equal(states, exact)
    assert np.array_equal(commands[:, : len(form.A)], form.C.astype(KINDS[precision]))
    assert not commands[:, len(form.A) :].any()


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


@pytest.mark.parametrize("name", ["kalman", "turned"])
def test_what_is_not_finite_holds_command_and_state(exported, name):
    theirs = Compiled(exported(name).files[0])
    last = theirs.step([1.0, -2.0], [0.3, 0.1])
    state = theirs.state.copy()
    for bad in (np.nan, np.inf, -np.inf):
        for y, applied in (([bad, 0], [0, 0]), ([0, 0], [0, bad])):
            assert np.array_equal(theirs.step(y, applied), last)
            assert theirs.held == 1
            assert np.array_equal(theirs.state, state)
    theirs.step([0.0, 0.0], last)
    assert theirs.held == 0


def test_a_filter_without_a_loop_has_no_such_form(tmp_path):
    lag = lbt.Controller(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    with pytest.raises(lbt.errors.ProblemError, match="needs the design of a loop"):
        export(tmp_path, bare_design(lag))
    with pytest.raises(lbt.errors.ProblemError, match="form must be one of plain, estimator"):
        lbt.interop.export_c(tmp_path / "k.c", bare_design(lag), form="observer")
    assert not list(tmp_path.iterdir())
