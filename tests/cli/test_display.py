"""Every command that prints a wavefront prints it in the unit that is asked for."""

import json
import re

import pytest
from support.configs import with_errors
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.storage.display_unit import DisplayUnit, own_display_unit, show_in

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
    "robustness": ("{}/c.yaml",),
    "plot sigma": ("{}/k.fits", "-o", "{}/g.svg"),
    "plot bode": ("{}/k.fits",),
    "plot step": ("{}/k.fits", "-o", "{}/t.svg"),
    "identify": ("{}/n.fits", "-o", "{}/i.yaml", "--no-figure"),
    "rehearse": ("{}/k.fits", "--for", "matlab", "--frames", "600"),
}


def run(capsys, files, command, *options):
    words = [word.format(files) for word in COMMANDS[command]]
    assert main([*command.split(), *words, *options]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("unit", ["mas", "urad"])
def test_no_nanometre_is_left(capsys, files, command, unit):
    option = "--show-unit" if command == "identify" else "--unit"
    out = run(capsys, files, command, option, unit)
    assert unit in out
    assert re.findall(r".*\bnm\b.*", out) == []


def test_no_nanometre_is_left_on_a_page(capsys, files):
    page = files / "r.html"
    words = ["report", f"{files}/c.yaml", f"{files}/k.fits", "--unit", "mas", "-o", str(page)]
    assert main(words) == 0
    text = re.sub(r"(?s)<(script|style|pre)\b.*?</\1>|<[^>]+>", " ", page.read_text())
    assert re.findall(r".*\bnm\b.*", text) == []
    assert "mas of noise per" in " ".join(text.split())
    capsys.readouterr()


def test_the_numbers_are_those_of_the_diameter(capsys, files):
    in_nm, in_mas = (
        float(
            re.search(r"estimation error, rms +([\d.]+)", run(capsys, files, "show", *o)).group(1)
        )
        for o in ((), ("--unit", "mas"))
    )
    assert in_nm / in_mas == pytest.approx(lbt.models.nm_per_mas(8.22), rel=1e-5)
    assert "nm" in run(capsys, files, "show")  # the choice was that of one command


def test_json_stays_in_nanometres(capsys, files):
    one, other = (
        json.loads(run(capsys, files, "limits", "--json", *o)) for o in ((), ("--unit", "mas"))
    )
    assert one == other


def test_a_configuration_may_choose(capsys, files, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text((files / "c.yaml").read_text() + "\nunits: mas\n")
    assert main(["robustness", str(own)]) == 0
    assert "residual [mas]" in capsys.readouterr().out
    assert main(["robustness", str(own), "--unit", "nm"]) == 0
    assert "residual [nm]" in capsys.readouterr().out


def test_an_angle_needs_a_diameter(capsys, tmp_path):
    plant = lbt.load_config(CONFIG).plant
    lbt.save_gain(tmp_path / "bare.fits", lbt.kalman(plant))
    assert main(["show", str(tmp_path / "bare.fits"), "--unit", "mas"]) == 2
    assert "telescope's diameter, which is not known here" in capsys.readouterr().err


def test_modes_beside_tilt_have_lengths_only(capsys, tmp_path):
    words = ["modal", CONFIG, "--modes", "6", "-o", str(tmp_path / "m.svg")]
    assert main([*words, "--unit", "um"]) == 0
    out = capsys.readouterr().out
    assert "residual [um]" in out
    assert re.findall(r".*\bnm\b.*", out) == []
    assert main([*words, "--unit", "mas"]) == 2
    assert "--unit mas is an angle of tip and tilt" in capsys.readouterr().err


def test_telemetry_is_shown_in_an_angle(capsys, files):
    """The rms of the series, which files and JSON have in nm."""
    path = str(files / "n.fits")
    assert main(["telemetry", path, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["units"]["residual_nm"] == "nm"
    assert main(["telemetry", path, "--unit", "mas"]) == 0
    (row,) = re.findall(r"residual_nm .*", capsys.readouterr().out)
    scale = lbt.models.nm_per_mas(data["diameter_m"])
    assert float(row.split()[-1]) == pytest.approx(data["rms"]["residual_nm"] / scale, rel=1e-5)
    assert row.split()[-2] == "mas"


def test_a_demand_has_its_limit_in_the_unit():
    step = lbt.design.shaping.CommandRms(at_most_nm=30.0, turbulence=None, noise_nm=5.0)
    with own_display_unit():
        show_in(DisplayUnit(name="mas", nm=10.0))
        assert step.label == "command stroke of at most 3 mas rms"
    assert step.label == "command stroke of at most 30 nm rms"
