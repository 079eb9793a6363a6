"""What commands show: wavefronts in the unit that is asked for, and the configured truth."""

import json
import re
from dataclasses import replace

import pytest
from support.commands import run
from support.configs import with_errors
from support.plants import LBT_YAML
from support.predictors import made
from support.robust_config import robust_writer

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small configuration, a gain file for it, and a simulated night of one run."""
    folder = tmp_path_factory.mktemp("units")
    text = LBT_YAML.read_text().replace("cases: 4", "cases: 1")
    small = folder / "c.yaml"
    small.write_text(with_errors(text, -1, 1))
    gain = str(lbt.save_gain(folder / "k.fits", lbt.load_config(small).design("kalman")))
    assert main(["simulate", str(small), gain, "--telemetry", str(folder / "n.fits")]) == 0
    return folder


COMMANDS = {
    "design": ("{}/c.yaml", "--method", "kalman", "-o", "{}/d.fits"),
    "show": ("{}/k.fits",),
    "simulate": ("{}/c.yaml", "{}/k.fits", "-o", "{}/s.svg"),
    "limits": ("{}/c.yaml", "{}/k.fits", "-o", "{}/l.svg"),
    "robustness": ("{}/c.yaml", "{}/k.fits"),
    "identify": ("{}/n.fits", "-o", "{}/i.yaml", "--no-figure"),
    "rehearse": ("{}/n.fits", "{}/k.fits", "--for", "matlab"),
}


def run_on(capsys, files, command, *options):
    words = [word.format(files) for word in COMMANDS[command]]
    status, text, _ = run(capsys, command, *words, *options)
    assert status == 0
    return text


def test_the_numbers_are_those_of_the_diameter(capsys, files):
    in_nm, in_mas = (
        float(
            re.search(
                r"estimation error, rms +([\d.]+)", run_on(capsys, files, "show", "--verbose", *o)
            ).group(1)
        )
        for o in ((), ("--unit", "mas"))
    )
    assert in_nm / in_mas == pytest.approx(lbt.models.nm_per_mas(8.22), rel=1e-5)
    assert "nm" in run_on(capsys, files, "show")  # the choice was that of one command


def test_json_stays_in_nanometres(capsys, files):
    one, other = (
        json.loads(run_on(capsys, files, "limits", "--json", *o)) for o in ((), ("--unit", "mas"))
    )
    assert one.pop("verdict") != other.pop("verdict")
    assert one == other


def test_an_angle_needs_a_diameter(capsys, tmp_path):
    plant = lbt.load_config(CONFIG).plant
    lbt.save_gain(tmp_path / "bare.fits", lbt.kalman(plant))
    assert main(["show", str(tmp_path / "bare.fits"), "--unit", "mas"]) == 2
    assert "telescope's diameter, which is not known here" in capsys.readouterr().err


def test_telemetry_is_shown_in_an_angle(capsys, files):
    """The rms of the series, which files and JSON have in nm."""
    path = str(files / "n.fits")
    assert main(["telemetry", path, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["units"]["residual_nm"] == "nm"
    assert main(["telemetry", path, "--show-unit", "mas"]) == 0
    (row,) = re.findall(r"residual_nm .*", capsys.readouterr().out)
    scale = lbt.models.nm_per_mas(data["diameter_m"])
    assert float(row.split()[-1]) == pytest.approx(data["rms"]["residual_nm"] / scale, rel=1e-5)
    assert row.split()[-2] == "mas"


LINE = "{kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}"


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
    assert text.startswith(
        "The Kalman filter leaves 51.0 nm rms in the truth (Strehl ratio 82.7 %)"
    )
    assert "35 % above the 37.8 nm of the best linear one" in " ".join(text.split())


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


def test_an_unstable_loop_in_the_truth_is_told(tmp_path, capsys):
    path, gain = tmp_path / "loud.yaml", tmp_path / "g.fits"
    text = LBT_YAML.read_text()
    assert "sensor_gain: 1.0 " in text
    path.write_text(text.replace("sensor_gain: 1.0 ", "sensor_gain: 3.0 "))
    status, out, _ = run(capsys, "design", path, "--method", "kalman", "-o", gain)
    assert status == 0
    assert out.startswith("The loop is unstable in the truth of loud.yaml.")


def test_a_configuration_in_a_gain_file_that_is_damaged_is_refused(tmp_path, capsys, config):
    design = config.design("integrator")
    assert lbt.load_gain(lbt.save_gain(tmp_path / "i.npz", design)).configuration == config.text
    gain = lbt.save_gain(tmp_path / "g.fits", replace(design, configuration='{"version": 3}'))
    status, _, error = run(capsys, "show", gain)
    assert status == 2
    assert error.startswith(f"lbt-synth: error: the configuration in {gain}: ")
    plain = lbt.save_gain(tmp_path / "p.fits", replace(design, configuration=""))
    assert "In the truth" not in run(capsys, "show", plain)[1]


@pytest.mark.parametrize(
    "command",
    [
        *(name for name in COMMANDS if name not in ("identify", "rehearse", "robustness")),
        "report",
        "compare",
        "modal",
    ],
)
def test_one_configuration_is_one_unit(capsys, files, tmp_path, command):
    """With ``units`` in the configuration, no command shows a wavefront in another one."""
    unit = "um" if command == "modal" else "mas"  # of all modes a length alone
    config, gain = tmp_path / "c.yaml", tmp_path / "k.fits"
    config.write_text((files / "c.yaml").read_text() + f"\nunits: {unit}\n")
    lbt.save_gain(gain, lbt.load_config(config).design("kalman"))
    more = {
        "report": ("{}/c.yaml", "{}/k.fits", "-o", "{}/r.html"),
        "compare": ("{}/c.yaml", "{}/k.fits"),
        "modal": ("{}/c.yaml", "--modes", "5"),
    }
    words = [word.format(tmp_path) for word in (COMMANDS | more)[command]]
    status, out, _ = run(capsys, command, *words)
    assert status == 0
    assert f" {unit}" in out or f"[{unit}" in out
    assert re.findall(r".*\bnm\b.*", out) == []


@pytest.mark.parametrize("command", ["simulate", "compare", "report"])
def test_a_truth_that_moves_no_accelerometer_says_nothing_of_a_predictor(tmp_path, capsys, command):
    gain = lbt.save_gain(tmp_path / "p.fits", made(residual_nm=106.2, alone_nm=167.4))
    output = ("-o", tmp_path / "r.html") if command == "report" else ()
    status, text, error = run(capsys, command, CONFIG, gain, *output)
    assert (status, text) == (2, "")
    assert f"{gain} reads a, ..., which nothing in the truth of lbt.yaml moves; its" in error
    assert f"record shows 106 nm: lbt-synth show {gain}." in error


def test_show_says_what_accelerometers_buy(tmp_path, capsys):
    gain = lbt.save_gain(tmp_path / "p.fits", made(residual_nm=106.2, alone_nm=167.4))
    status, text, _ = run(capsys, "show", gain)
    assert status == 0
    assert " ".join(text.split()).startswith(
        "The least-squares predictor leaves 106 nm with the accelerometers, 167 nm without them, "
        "on unseen frames of its record."
    )
    status, _, error = run(
        capsys, "design", CONFIG, "--method", "predictor", "-o", tmp_path / "q.fits"
    )
    assert (status, error) == (
        2,
        "lbt-synth: error: the method predictor is made of a record; got a plant or a "
        "configuration alone. Try lbt-synth auto RECORD --method predictor.\n",
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
