"""What design and show print of the configured truth."""

import json
from dataclasses import replace

import pytest
from support.commands import run
from support.plants import LBT_YAML
from support.robust_config import robust_writer

import lbt_synth as lbt

LINE = "{kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}"
SHAKEN = """
  robust:
    bands:
      - {low_hz: 19.0, high_hz: 21.0, rms_mas: 80.0, axis: tip}
    modulus_margin: 0.8
    functions: 12
    states: null
"""


def truth_of(capsys, *arguments):
    status, text, _ = run(capsys, *arguments, "--json")
    assert status == 0
    return json.loads(text)


def test_design_and_show_give_the_residual_in_the_truth(tmp_path, capsys, config):
    gain = tmp_path / "k.fits"
    made = truth_of(capsys, "design", LBT_YAML, "--method", "kalman", "-o", gain)
    shown = truth_of(capsys, "show", gain)
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
    status, text, _ = run(capsys, "show", gain)
    assert status == 0
    assert "In the truth of k.fits; Strehl ratio at 2.2 um" in text
    assert "least residual of any linear controller in the truth: 37.7777 nm rms" in text


def test_the_wavelength_is_that_of_the_file(tmp_path, capsys):
    path = tmp_path / "k_band.yaml"
    path.write_text(LBT_YAML.read_text().replace("wavelength_um: 2.2", "wavelength_um: 1.65"))
    gain = tmp_path / "g.npz"
    status, text, _ = run(capsys, "design", path, "--method", "integrator", "-o", gain)
    assert (status, "In the truth of k_band.yaml; Strehl ratio at 1.65 um" in text) == (0, True)
    assert "at 1.65 um" in run(capsys, "show", gain)[1]


def test_a_residual_that_the_design_does_not_expect_is_a_warning(tmp_path, capsys):
    gain = tmp_path / "g.fits"
    still = LBT_YAML.with_name("lbt_robust.yaml")  # its model has no vibration
    status, text, _ = run(capsys, "design", still, "--method", "kalman", "-o", gain)
    assert status == 0
    assert (
        "warning: the truth leaves 776 nm in means over frames, where the design expects 12 nm"
        in text
    )
    drifts = tmp_path / "drifts.yaml"
    moving = (
        "{kind: drift, axis: tip, frequency_hz: 20.0, end_hz: 21.0, duration_s: 9, rms_mas: 80.0}"
    )
    drifts.write_text(LBT_YAML.read_text().replace(LINE, moving))
    status, text, _ = run(capsys, "design", drifts, "--method", "kalman", "-o", gain)
    assert status == 0
    assert "a vibration of the truth drifts" in text
    assert "In the truth" not in text


def test_a_demand_that_costs_residual_is_named(tmp_path, capsys):
    model = (
        "    kind: ar2",
        (
            "    kind: ar2\n  vibrations:\n"
            "    - {axis: tip, frequency_hz: 20.0, damping: 0.005, rms_mas: 80.0}"
        ),
    )
    path, gain = robust_writer(tmp_path)(SHAKEN, model=model), tmp_path / "r.fits"
    status, text, _ = run(capsys, "design", path, "--method", "robust", "-o", gain)
    assert status == 0
    better = [line for line in text.splitlines() if "leaves less in the truth" in line]
    assert better
    assert all("it violates: modulus margin of at least 0.8" in line for line in better)


def test_an_unstable_loop_in_the_truth_is_told(tmp_path, capsys):
    path, gain = tmp_path / "loud.yaml", tmp_path / "g.fits"
    text = LBT_YAML.read_text()
    assert "sensor_gain: 1.0 " in text
    path.write_text(text.replace("sensor_gain: 1.0 ", "sensor_gain: 3.0 "))
    status, out, _ = run(capsys, "design", path, "--method", "kalman", "-o", gain)
    assert status == 0
    assert "warning: the loop is unstable in the truth." in out


def test_a_configuration_in_a_gain_file_that_is_damaged_is_refused(tmp_path, capsys, config):
    design = config.design("integrator")
    assert lbt.load_gain(lbt.save_gain(tmp_path / "i.npz", design)).configuration == config.text
    gain = lbt.save_gain(tmp_path / "g.fits", replace(design, configuration='{"version": 3}'))
    status, _, error = run(capsys, "show", gain)
    assert status == 2
    assert error.startswith(f"lbt-synth: error: the configuration in {gain}: ")
    plain = lbt.save_gain(tmp_path / "p.fits", replace(design, configuration=""))
    assert "In the truth" not in run(capsys, "show", plain)[1]
