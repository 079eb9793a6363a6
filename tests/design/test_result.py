"""What every design is: frozen, checked, a controller for others; what it shows and expects."""

import sys
from dataclasses import FrozenInstanceError, replace
from xml.etree import ElementTree

import numpy as np
import pytest
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import CertificateError, ProblemError


@pytest.fixture(scope="module")
def design(config):
    return lbt.kalman(config.plant)


def values(text):
    """Return the last words of the lines of facts, by their headings."""
    rows = (line.strip().split("  ") for line in text.splitlines()[1:])
    return {row[0]: [cell.strip() for cell in row[1:] if cell.strip()] for row in rows}


def test_a_printed_design_has_at_most_ten_lines_and_its_facts(config, design):
    shown = values(str(design))
    margins = lbt.loop_margins(lbt.close_loop(design.hardware, design))
    count = len(design.certificate.checks)
    expected = {
        "residual in its model, rms": [f"{design.facts().residual_nm:.6g}", "nm"],
        "modulus margin": [f"{margins.modulus:.6g}"],
        "certificate": [f"{count} of {count} checks passed"],
    }
    assert shown | expected == shown
    for method in ("kalman", "integrator"):
        lines = str(config.design(method)).splitlines()
        own = [line for line in lines if line.startswith(("  residual in its model", "  gain"))]
        assert (len(own), len(lines) <= 10) == (1, True)


def test_what_is_shown_of_a_failed_check_and_of_a_bare_problem(design):
    failed = replace(design.certificate.checks[0], value=2.0, limit=1.0)
    certificate = replace(design.certificate, checks=(failed,))
    assert f"failed: {failed.name}" in str(replace(design, certificate=certificate))
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    shown = values(str(lbt.kalman(walk)))  # without units or margins
    assert shown["estimation error, rms"] == ["1.27202"]  # the root of the golden ratio
    assert "modulus margin" not in shown


def test_whatever_a_script_holds_is_one_line_and_a_page(config, design):
    loop = lbt.close_loop(config.hardware, design, sensor_gain=config.truth.sensor_gain)
    quiet = replace(config.truth, vibrations=())
    budget = lbt.residual_budget(loop, quiet)
    bare = lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1)
    things = [config, config.plant, config.truth, design, loop, loop.system, design.controller]
    things += [config.hardware, design.certificate, budget, lbt.loop_margins(loop), bare]
    run = lbt.simulate(design, config.truth, hardware=config.hardware, frames=10, settle_frames=0)
    for thing in [*things, run]:
        assert repr(thing).startswith(f"<{type(thing).__name__}: ")
        assert len(repr(thing)) <= 100
        assert "\n" not in repr(thing)
        assert "array" not in str(thing)
        assert ElementTree.fromstring(thing._repr_html_()).text == str(thing)
    shown = values(str(budget))
    assert shown["vibrations"] == ["0.0", "nm rms"]
    assert float(shown["residual"][0]) == pytest.approx(budget.rms_nm, abs=0.05)


def test_wrong_arguments_are_refused_in_words(config, design):
    close, path = lbt.close_loop, config.hardware
    kalman = r"got Config. Try config\.plant, or config\.design\(\.\.\.\)\."
    robust = r"plant must be a TipTiltPlant; got Config. Try config\.plant"
    hardware = r"hardware must be .*; got Config. Try config\.hardw"
    loop = "loop must be a ClosedLoop; got FilterDesign"
    rows = [
        (lambda: lbt.kalman(config), ProblemError, kalman),
        (lambda: lbt.robust(config), ProblemError, robust),
        (lambda: close(config, design), ProblemError, hardware),
        (lambda: close(path, config.plant), ProblemError, "must be a Controller, or a des"),
        (lambda: lbt.loop_margins(design), ProblemError, loop),
    ]
    require_refusals(rows)


def test_designs_are_frozen(design):
    refused(lambda: setattr(design, "method", "other"), FrozenInstanceError, "method")
    refused(lambda: design.gain_predictor.fill(0), ValueError, "read-only")


def test_wrong_solver_answers_do_not_leave_the_library(monkeypatch, axis_plant):
    """Solvers are not believed: a gain that is off by 1e-3 fails its certificate."""
    # the package has functions of these names
    kalman, hinf = (sys.modules[f"lbt_synth.design.{name}"] for name in ("kalman", "hinf"))
    right = kalman.kalman_riccati(axis_plant)
    wrong = replace(right, gain_predictor=right.gain_predictor * 1.001)
    monkeypatch.setattr(kalman, "kalman_riccati", lambda _: wrong)
    error = refused(lambda: lbt.kalman(axis_plant), CertificateError, "least-variance gain")
    names = "distance from the least-variance gain", "distance from its Riccati filter"
    assert error.failed == names
    central = hinf.gamma_riccati(axis_plant, 1e3, start=right)
    unstable = replace(central, gain_predictor=np.full((4, 1), 5.0))
    monkeypatch.setattr(hinf, "gamma_riccati", lambda *_, **__: unstable)
    with pytest.raises(CertificateError, match="spectral radius of the filter"):
        lbt.hinf(axis_plant, gamma_ratio=1.2, route="riccati")


def test_what_a_design_expects_to_leave(axis_plant, design):
    assert design.expected_residual_nm == design.rms
    bare = lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    assert lbt.kalman(bare).expected_residual_nm is None
    assert lbt.integrator(axis_plant.hardware, gain=0.4).expected_residual_nm is None
