"""What commands show: wavefronts in the unit that is asked for, and the configured truth."""

import re

import pytest
from support.commands import run_done, run_json
from support.configs import write_config
from support.plants import LBT_YAML
from support.predictors import made
from support.robust_config import robust_writer

import lbt_synth as lbt

KALMAN = ("--method", "kalman", "-o")


def test_json_stays_in_nanometres_and_an_angle_needs_a_diameter(tmp_path, capsys, config, gains):
    gain = lbt.save_gain(tmp_path / "k.fits", config.design("integrator"))
    in_nm, in_mas = (run_json(capsys, "show", gain, *unit) for unit in ((), ("--unit", "mas")))
    nm, mas = (float(data.pop("verdict")[1].split()[3]) for data in (in_nm, in_mas))
    assert nm / mas == pytest.approx(lbt.models.nm_per_mas(8.22), rel=5e-3)
    assert in_nm == in_mas
    assert " mas" not in run_done(capsys, "show", gain)  # the choice was that of one command


def test_design_and_show_give_the_residual_in_the_truth(tmp_path, capsys, config):
    gain = tmp_path / "k.fits"
    designed = run_json(capsys, "design", LBT_YAML, *KALMAN, gain)
    loop = lbt.close_loop(config.hardware, lbt.load_gain(gain).controller)
    exact = lbt.residual_budget(loop, config.truth)
    expected = {"residual_nm": exact.rms_nm, "strehl": lbt.strehl(exact, config.imaging)}
    for data in (designed, run_json(capsys, "show", gain)):
        ours, *others = data["truth"]
        assert ours["design"] == "this design"
        assert {name: ours[name] for name in expected} == pytest.approx(expected)
        assert [row["design"] for row in others] == ["integrator", "hinf"]  # it is kalman itself
        # the limit in the truth, and the residual in the model of the design
        numbers = [data[name] for name in ("truth_limit_nm", "residual_nm", "wavelength_um")]
        assert numbers == pytest.approx([37.7777, 205.1432, 2.2], abs=1e-4, rel=0)


def test_an_unstable_loop_in_the_truth_is_told(tmp_path, capsys):
    """And so is a residual that the design does not expect: its model has no vibration."""
    loud = LBT_YAML.read_text().replace("sensor_gain: 1.0 ", "sensor_gain: 3.0 ")
    still = LBT_YAML.with_name("lbt_robust.yaml")
    for file, words in (
        (write_config(tmp_path, loud), r"^The loop is unstable in the truth of c\.yaml\."),
        (still, "warning: the truth leaves 776 nm in means over frames, where the design expects"),
    ):
        out = run_done(capsys, "design", file, *KALMAN, tmp_path / "g.fits")
        assert re.search(words, out), out


def test_a_predictor_says_what_accelerometers_buy(tmp_path, capsys):
    """A truth that moves no accelerometer says nothing of it."""
    gain = lbt.save_gain(tmp_path / "p.fits", made(residual_nm=106.2, alone_nm=167.4))
    assert " ".join(run_done(capsys, "show", gain).split()).startswith(
        "The least-squares predictor leaves 106 nm with the accelerometers, 167 nm without them, "
        "on unseen frames of its record."
    )


SHAKEN = """
  robust:
    bands:
      - {low_hz: 19.0, high_hz: 21.0, rms_mas: 80.0, axis: tip}
    modulus_margin: 0.8
    functions: 12
    states: null
"""


def test_a_demand_that_costs_residual_is_named(tmp_path, capsys):
    line = "    - {axis: tip, frequency_hz: 20.0, damping: 0.005, rms_mas: 80.0}"
    model = ("    kind: ar2", f"    kind: ar2\n  vibrations:\n{line}")
    path, gain = robust_writer(tmp_path)(SHAKEN, model=model), tmp_path / "r.fits"
    text = run_done(capsys, "design", path, "--method", "robust", "-o", gain)
    better = [line for line in text.splitlines() if "leaves less in the truth" in line]
    assert better
    assert all("it violates: modulus margin of at least 0.8" in line for line in better)
    shown = run_json(capsys, "show", gain)  # as other commands do
    assert (shown["method"], len(shown["terms"]), 0 < shown["loss"] < 0.1) == ("robust", 3, True)
    assert run_json(capsys, "verify", gain)["passed"] is True
    run_done(capsys, "plot", "sigma", gain)
    run_done(capsys, "simulate", path, gain, "--frames", 500, "--cases", 1)
