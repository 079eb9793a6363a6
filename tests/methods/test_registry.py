"""All that the package knows of a method of synthesis stands in the table."""

import ast

import numpy as np
import pytest
from pydantic import Field
from support.commands import refuse_commands, run_done, run_json
from support.plants import ROOT
from support.refusals import require_refusals

from lbt_synth.design import Check, Design
from lbt_synth.design.certificate import Claim
from lbt_synth.design.result import SolverReport, with_certificate
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller
from lbt_synth.methods.method import Method, Section
from lbt_synth.methods.registry import METHODS, design_label, method_named, reference_methods
from lbt_synth.methods.request import design_request

BUILT_IN = ("hinf", "integrator", "kalman", "lqg", "mixed", "predictor", "robust")


class LeakyOptions(Section):
    """Options of a method that the package does not have: a leaky integrator."""

    gain: float = Field(default=0.3, gt=0, description="its gain")
    leak_per_s: float = Field(gt=0, description="part of the command lost [1/s]", examples=[5])


def check_leak(evidence, leak_per_s):
    """Check that the controller forgets as fast as it claims."""
    k = evidence.design.controller
    error = k.A[0, 0] / np.exp(-leak_per_s * k.dt_s) - 1
    yield Check("leak, against the one claimed", abs(error), 1e-9, "eigenvalue")


class LeakyDesign(Design):
    CLAIMS = (
        Claim(name="gain", heading="gain"),
        Claim(name="leak_per_s", heading="leak", unit="1/s", checks=check_leak),
    )

    def make_controller(self):
        """Return the controller of the claims."""
        path, unit = self.problem, np.eye(self.problem.modes)
        back = self.claims["gain"] * np.linalg.pinv(path.sensor @ path.influence)
        A = np.exp(-self.claims["leak_per_s"] * path.dt_s) * unit
        return Controller(A=A, B=back, C=unit, D=0 * back, dt_s=path.dt_s)


def build(inputs, options):
    claims = {"problem": inputs.plant.hardware, "claims": options.model_dump()}
    solver = SolverReport(route="closed form", status="given")
    return with_certificate(LeakyDesign(method="leaky", solver=solver, **claims), "Lower the gain.")


@pytest.fixture
def leaky(monkeypatch):
    """The method of a file that is added to the table."""
    method = Method(
        name="leaky",
        title="leaky integrator",
        label="leaky",
        options=LeakyOptions,
        build=build,
        design=f"{__name__}:LeakyDesign",
        estimator=False,
        configurable=frozenset({"gain"}),
    )
    monkeypatch.setitem(METHODS, "leaky", method)
    return method_named("leaky")


def test_methods_by_name(leaky, config):
    assert tuple(name for name in METHODS if name != "leaky") == BUILT_IN
    assert leaky.title == "leaky integrator"
    assert [m.name for m in reference_methods()] == ["integrator", "kalman", "hinf"]
    assert [m.name for m in reference_methods(estimators_only=True)] == ["kalman", "hinf"]
    assert (leaky.needs_options, method_named("mixed").needs_options) == (True, False)
    assert design_label(config.design("leaky", leak_per_s=1.0).method) == "leaky"
    assert design_label("kalman") == "Kalman"
    rows = [
        (lambda: method_named("kalmann"), r"got 'kalmann'. Did you mean kalman\?"),
        (lambda: design_request("hinf", {"gama_ratio": 1.2}), "gama_ratio is no option of method "),
        (lambda: design_request("hinf", {"weird": 1}), "known are gamma, gamma_ratio, route"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


def test_commands_take_a_method_of_the_table(leaky, small_config, tmp_path, capsys):
    help_text = " ".join(run_done(capsys, "design", "--help").split())
    assert "leaky: leaky integrator" in help_text
    assert "--leak-per-s LEAK_PER_S leaky: part of the command lost [1/s]" in help_text
    gain, design = tmp_path / "leaky.fits", "design CONFIG --method leaky -o GAIN"
    rows = [
        (design, "--leak-per-s, the part of the command lost [1/s]; try --leak-per-s 5"),
        (f"{design} --leak-per-s -1", "lbt-synth: error: --leak-per-s must be above 0; got -1.\n"),
    ]
    places = {"CONFIG": small_config.source, "GAIN": gain}
    refuse_commands(capsys, rows, **places)
    words = [places.get(word, word) for word in f"{design} --leak-per-s 5 --verbose".split()]
    assert "leak, against the one claimed" in run_done(capsys, *words)
    shown = run_json(capsys, "show", gain)
    assert (shown["leak_per_s"], shown["gain"]) == (5.0, 0.3)
    assert shown["matrices"]["A"] == pytest.approx(np.exp(-5 / 800) * np.eye(2))
    run_done(capsys, "verify", gain)


def test_no_other_file_names_a_method():
    """A method's name stands in the table, and in the design that it makes."""
    for path in (ROOT / "lbt_synth").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        elsewhere = path.relative_to(ROOT).parts[1] not in ("design", "methods")
        if elsewhere and any(name in text for name in BUILT_IN):
            strings = {n.value for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Constant)}
            assert not strings & (set(BUILT_IN) - {"integrator"}), path  # a control law, too
