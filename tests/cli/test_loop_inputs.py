"""What commands show: wavefronts in the unit that is asked for, and the configured truth."""

from dataclasses import replace

import pytest
from support.commands import refuse_commands, run, run_done, run_json
from support.plants import LBT_YAML
from support.predictors import made
from support.robust_config import robust_writer

import lbt_synth as lbt

CONFIG = str(LBT_YAML)
KALMAN = ("--method", "kalman", "-o")


def test_json_stays_in_nanometres_and_an_angle_needs_a_diameter(tmp_path, capsys, config, gains):
    gain = lbt.save_gain(tmp_path / "k.fits", config.design("integrator"))
    in_nm, in_mas = (run_json(capsys, "show", gain, *unit) for unit in ((), ("--unit", "mas")))
    nm, mas = (float(data.pop("verdict")[1].split()[3]) for data in (in_nm, in_mas))
    assert nm / mas == pytest.approx(lbt.models.nm_per_mas(8.22), rel=5e-3)
    assert in_nm == in_mas
    bare = "a wavefront is shown in mas by the telescope's diameter, which is not known here"
    refuse_commands(capsys, [("show GAIN --unit mas", bare)], GAIN=gains["kalman"])
    assert " mas" not in run_done(capsys, "show", gain)  # the choice was that of one command


def test_design_and_show_give_the_residual_in_the_truth(tmp_path, capsys, config):
    gain = tmp_path / "k.fits"
    made, shown = (
        run_json(capsys, *words) for words in (("design", LBT_YAML, *KALMAN, gain), ("show", gain))
    )
    loop = lbt.close_loop(config.hardware, lbt.load_gain(gain).controller)
    exact = lbt.residual_budget(loop, config.truth)
    for data in (made, shown):
        ours, *others = data["truth"]
        assert ours["design"] == "this design"
        assert ours["residual_nm"] == pytest.approx(exact.rms_nm)
        assert ours["strehl"] == pytest.approx(lbt.strehl(exact, config.imaging))
        assert [row["design"] for row in others] == ["integrator", "hinf"]  # it is kalman itself
        assert data["truth_limit_nm"] == pytest.approx(37.7777, abs=1e-4)
        assert data["wavelength_um"] == 2.2
        assert data["residual_nm"] == pytest.approx(205.143, abs=1e-3)  # in its model


def test_a_residual_that_the_design_does_not_expect_is_a_warning(tmp_path, capsys):
    gain = tmp_path / "g.fits"
    still = LBT_YAML.with_name("lbt_robust.yaml")  # its model has no vibration
    text = run_done(capsys, "design", still, *KALMAN, gain)
    assert "warning: the truth leaves 776 nm in means over frames, where the design expects" in text


def test_an_unstable_loop_in_the_truth_is_told(tmp_path, capsys):
    path, text = tmp_path / "loud.yaml", LBT_YAML.read_text()
    assert "sensor_gain: 1.0 " in text
    path.write_text(text.replace("sensor_gain: 1.0 ", "sensor_gain: 3.0 "))
    out = run_done(capsys, "design", path, *KALMAN, tmp_path / "g.fits")
    assert out.startswith("The loop is unstable in the truth of loud.yaml.")


def test_a_configuration_in_a_gain_file_that_is_damaged_is_refused(tmp_path, capsys, config):
    design = config.design("integrator")
    gain = lbt.save_gain(tmp_path / "g.fits", replace(design, configuration='{"version": 3}'))
    refuse_commands(capsys, [(f"show {gain}", f"error: the configuration in {gain}: ")])


def test_a_predictor_says_what_accelerometers_buy(tmp_path, capsys):
    """A truth that moves no accelerometer says nothing of it."""
    gain = lbt.save_gain(tmp_path / "p.fits", made(residual_nm=106.2, alone_nm=167.4))
    assert " ".join(run_done(capsys, "show", gain).split()).startswith(
        "The least-squares predictor leaves 106 nm with the accelerometers, 167 nm without them, "
        "on unseen frames of its record."
    )
    still = (
        f"{gain} reads a, ..., which nothing in the truth of lbt.yaml moves; its record shows 106 "
        f"nm: lbt-synth show {gain}."
    )
    rows = [(f"{command} {CONFIG} {gain}", still) for command in ("simulate", "compare")]
    advice = "configuration alone. Try lbt-synth auto RECORD --method predictor."
    rows.append((f"design {CONFIG} --method predictor -o {tmp_path}/q.fits", advice))
    refuse_commands(capsys, rows)


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
    status, text, _ = run(capsys, "design", path, "--method", "robust", "-o", gain)
    better = [line for line in text.splitlines() if "leaves less in the truth" in line]
    assert (status, better != []) == (0, True)
    assert all("it violates: modulus margin of at least 0.8" in line for line in better)
