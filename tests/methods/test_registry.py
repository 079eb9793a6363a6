"""All that the package knows of a method of synthesis stands in the table."""

import ast
import json

import numpy as np
import pytest
from support import leaky_method
from support.commands import run
from support.plants import LBT_YAML, ROOT

from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import METHODS, design_label, method_named, reference_methods
from lbt_synth.methods.request import design_request

CONFIG = str(LBT_YAML)
BUILT_IN = ("hinf", "integrator", "kalman", "lqg", "mixed", "predictor", "robust")


@pytest.fixture
def leaky(monkeypatch):
    """The method of a file that is added to the table."""
    monkeypatch.setitem(METHODS, "leaky", leaky_method.METHOD)
    return method_named("leaky")


def test_methods_by_name(leaky):
    assert tuple(name for name in METHODS if name != "leaky") == BUILT_IN
    assert leaky.title == leaky_method.METHOD.title
    assert [m.name for m in reference_methods()] == ["integrator", "kalman", "hinf"]
    assert [m.name for m in reference_methods(estimators_only=True)] == ["kalman", "hinf"]
    assert leaky.needs_options
    assert not method_named("mixed").needs_options
    for call, words in (
        (lambda: method_named("kalmann"), r"got 'kalmann'. Did you mean kalman\?"),
        (lambda: design_request("hinf", {"gama_ratio": 1.2}), "gama_ratio is no option of method "),
        (lambda: design_request("hinf", {"weird": 1}), "known are gamma, gamma_ratio, route"),
    ):
        with pytest.raises(ProblemError, match=words):
            call()


def test_labels(leaky, config):
    assert design_label(config.design("leaky", leak_per_s=1.0).method) == "leaky"
    assert design_label(config.design("kalman").method) == "Kalman"


def test_commands_take_a_method_of_the_table(leaky, small_config, tmp_path, capsys):
    gain = tmp_path / "leaky.fits"
    status, text, _ = run(capsys, "design", "--help")
    assert status == 0
    help_text = " ".join(text.split())
    assert "leaky: leaky integrator" in help_text
    assert "--leak-per-s LEAK_PER_S leaky: part of the command lost [1/s]" in help_text
    design = ("design", small_config.source, "--method", "leaky", "-o", gain)
    status, _, error = run(capsys, *design)
    assert (status, "--leak-per-s, the part of the command lost" in error) == (2, True)
    assert "try --leak-per-s 5" in error
    status, _, error = run(capsys, *design, "--leak-per-s", "-1")
    assert (status, error) == (2, "lbt-synth: error: --leak-per-s must be above 0; got -1.\n")
    status, out, error = run(capsys, *design, "--leak-per-s", "5", "--verbose")
    assert (status, error) == (0, "")
    assert "leak, against the one claimed" in out
    status, out, _ = run(capsys, "show", gain, "--json")
    shown = json.loads(out)
    assert (status, shown["leak_per_s"], shown["gain"]) == (0, 5.0, 0.3)
    assert shown["matrices"]["A"] == pytest.approx(np.exp(-5 / 800) * np.eye(2))
    assert run(capsys, "verify", gain)[0] == 0


STUDY = """\
version: 1
config: {config}
samples: 4
controllers:
  forgetful: {{design: leaky, leak_per_s: 5.0}}
  own: {{design: leaky, leak_per_s: {leak}, for: sample}}
parameters:
  truth.vibrations[0].frequency_hz: {{uniform: [18.0, 22.0]}}
"""


def test_a_study_takes_a_method_of_the_table(leaky, tmp_path, capsys):
    study = tmp_path / "study.yaml"
    study.write_text(STUDY.format(config=CONFIG, leak=5.0))
    status, _, error = run(capsys, "study", study, "-o", tmp_path / "out")
    assert (status, error) == (0, "")
    rows = np.genfromtxt(tmp_path / "out" / "results.csv", delimiter=",", names=True)
    assert np.all(rows["forgetfulstable"] == 1)
    np.testing.assert_allclose(rows["forgetfulstrehl"], rows["ownstrehl"], rtol=1e-9)
    study.write_text(STUDY.format(config=CONFIG, leak=-1.0))
    status, _, error = run(capsys, "study", study, "-o", tmp_path / "out2")
    assert status == 2
    assert "controllers.own: leak_per_s must be above 0; got -1." in error


def test_no_other_file_names_a_method():
    """A method's name stands in the table, and in the design that it makes."""
    for path in (ROOT / "lbt_synth").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        elsewhere = path.relative_to(ROOT).parts[1] not in ("design", "methods")
        if elsewhere and any(name in text for name in BUILT_IN):
            strings = {n.value for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Constant)}
            assert not strings & (set(BUILT_IN) - {"integrator"}), path  # a control law, too
