"""What every design is: frozen, checked, a controller for others; what it shows and expects."""

import sys
from dataclasses import FrozenInstanceError, replace
from xml.etree import ElementTree

import control
import numpy as np
import pytest
from support.plants import ROOT

import lbt_synth as lbt

AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)


@pytest.fixture(scope="module")
def config():
    return lbt.load_config(ROOT / "examples" / "lbt.yaml")


@pytest.fixture(scope="module")
def design(config):
    return lbt.kalman(config.plant)


def values(text):
    """The last words of the lines of facts, by their headings."""
    rows = (line.strip().split("  ") for line in text.splitlines()[1:])
    return {row[0]: [cell.strip() for cell in row[1:] if cell.strip()] for row in rows}


def test_a_printed_design_has_at_most_ten_lines_and_its_facts(design):
    shown, own = values(str(design)), design.facts()
    margins = lbt.loop_margins(lbt.close_loop(design.hardware, design))
    assert 8 <= len(str(design).splitlines()) <= 10
    assert shown["residual in its model, rms"] == [f"{own.residual_nm:.6g}", "nm"]
    assert shown["modulus margin"] == [f"{margins.modulus:.6g}"]
    count = len(design.certificate.checks)
    assert shown["certificate"] == [f"{count} of {count} checks passed"]


def test_assumptions_and_failed_checks_are_said(design):
    failed = replace(design.certificate.checks[0], value=2.0, limit=1.0)
    certificate = replace(design.certificate, checks=(failed,))
    text = str(replace(design, certificate=certificate, assumptions=("the gain is 1",)))
    assert f"failed: {failed.name}" in text
    assert text.endswith("assumes: the gain is 1.")


def test_a_design_whose_loop_is_unstable_is_shown_without_margins(design):
    slow = replace(design.problem, hardware=replace(design.hardware, delay_frames=9.0))
    loop = lbt.close_loop(slow.hardware, lbt.integrator(design.hardware, gain=0.9))
    assert not loop.is_stable
    unstable = replace(lbt.integrator(design.hardware, gain=0.9), problem=slow.hardware)
    assert set(values(str(unstable))) == {"gain", "certificate"}


def test_a_bare_problem_has_neither_units_nor_margins():
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    shown = values(str(lbt.kalman(walk)))
    assert shown["estimation error, rms"] == ["1.27202"]  # the root of the golden ratio
    assert "modulus margin" not in shown


@pytest.mark.parametrize("method", ["integrator", "lqg", "hinf"])
def test_every_method_prints_its_residual_or_gain_once(config, method):
    lines = str(config.design(method)).splitlines()
    own = [line for line in lines if line.startswith(("  residual in its model", "  gain"))]
    assert len(own) == 1
    assert len(lines) <= 10


def test_whatever_a_script_holds_is_one_line_and_a_page(config, design):
    loop = lbt.close_loop(config.hardware, design, sensor_gain=config.truth.sensor_gain)
    budget = lbt.residual_budget(loop, config.truth)
    things = [config, config.plant, config.truth, design, loop, loop.system, design.controller]
    things.append(
        lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1)).problem
    )
    things += [config.hardware, design.certificate, budget, lbt.loop_margins(loop)]
    run = lbt.simulate(design, config.truth, hardware=config.hardware, frames=10, settle_frames=0)
    for thing in [*things, run]:
        assert repr(thing).startswith(f"<{type(thing).__name__}: ")
        assert len(repr(thing)) <= 100
        assert "\n" not in repr(thing)
        assert "array" not in str(thing)
        assert ElementTree.fromstring(thing._repr_html_()).text == str(thing)


def test_the_budget_is_shown_by_origin(config, design):
    truth = replace(config.truth, vibrations=())
    loop = lbt.close_loop(config.hardware, design, sensor_gain=truth.sensor_gain)
    budget = lbt.residual_budget(loop, truth)
    shown = values(str(budget))
    assert shown["vibrations"] == ["0.0", "nm rms"]
    assert float(shown["residual"][0]) == pytest.approx(budget.rms_nm, abs=0.05)


def test_designs_go_where_controllers_go(config, design):
    assert np.array_equal(
        lbt.close_loop(config.hardware, design).system.A,
        lbt.close_loop(config.hardware, design.controller).system.A,
    )
    gains = lbt.loop.stable_sensor_gains
    assert gains(config.hardware, design) == gains(config.hardware, design.controller)
    given = {"hardware": config.hardware, "frames": 20, "settle_frames": 0}
    runs = [lbt.simulate(one, config.truth, **given) for one in (design, design.controller)]
    assert np.array_equal(runs[0].residual_nm, runs[1].residual_nm)


def test_wrong_arguments_are_refused_in_words(config, design):
    refused = [
        (
            lambda: lbt.kalman(config),
            r"got Config. Try config\.plant, or config\.design\(\.\.\.\)\.",
        ),
        (
            lambda: lbt.robust(config),
            r"plant must be a TipTiltPlant; got Config. Try config\.plant",
        ),
        (
            lambda: lbt.close_loop(config, design),
            r"hardware must be .*; got Config. Try config\.hardw",
        ),
        (lambda: lbt.close_loop(config.hardware, config.plant), "must be a Controller, or a des"),
        (lambda: lbt.residual_budget(design, config.truth), "loop must be a ClosedLoop; got Filt"),
        (lambda: lbt.loop_margins(design), "loop must be a ClosedLoop; got FilterDesign"),
    ]
    for call, message in refused:
        with pytest.raises(lbt.errors.ProblemError, match=message):
            call()


def test_a_robust_design_needs_no_bands(config):
    robust = lbt.robust(config.plant, sensor_gain=(0.8, 1.1), functions=8, states=None)
    low, high = lbt.loop.stable_sensor_gains(config.hardware, robust)
    assert low < 0.8
    assert high > 1.1


def test_designs_are_frozen(axis_plant):
    design = lbt.kalman(axis_plant)
    with pytest.raises(FrozenInstanceError):
        design.method = "other"
    with pytest.raises(ValueError, match="read-only"):
        design.gain_predictor[0, 0] = 0


def test_a_wrong_solver_answer_does_not_leave_the_library(monkeypatch, axis_plant):
    """Solvers are not believed: a gain that is off by 1e-3 fails its certificate."""
    module = sys.modules["lbt_synth.design.kalman"]  # the package has the function of that name
    right = module.kalman_riccati(axis_plant)
    wrong = replace(right, gain_predictor=right.gain_predictor * 1.001)
    monkeypatch.setattr(module, "kalman_riccati", lambda _: wrong)
    with pytest.raises(lbt.errors.CertificateError, match="least-variance gain") as caught:
        lbt.kalman(axis_plant)
    assert caught.value.failed == (
        "distance from the least-variance gain",
        "predictor gain against the filter gain",
        "distance from its Riccati filter",
    )


def test_an_unstable_optimal_filter_does_not_leave_the_library(monkeypatch, axis_plant):
    module = sys.modules["lbt_synth.design.hinf"]
    central = module._central

    def lie(*arguments):
        return replace(central(*arguments), gain_predictor=np.full((4, 1), 5.0))

    monkeypatch.setattr(module, "_central", lie)
    with pytest.raises(lbt.errors.CertificateError, match="spectral radius of the filter"):
        lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")


def test_to_control_is_the_same_controller(axis_plant):
    design = lbt.kalman(axis_plant)
    system = design.to_control()
    assert isinstance(system, control.StateSpace)
    y = np.random.default_rng(0).standard_normal(200)
    run = design.controller.start()
    stepped = [run.step([value])[0] for value in y]
    _, response = control.forced_response(system, U=y)
    assert np.allclose(np.ravel(response), stepped, rtol=1e-9, atol=1e-12)


def test_what_a_design_expects_to_leave(axis_plant):
    filter_design = lbt.kalman(axis_plant)
    assert filter_design.expected_residual_nm == filter_design.rms
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert lbt.kalman(bare).expected_residual_nm is None
    assert lbt.integrator(axis_plant.hardware, gain=0.4).expected_residual_nm is None
