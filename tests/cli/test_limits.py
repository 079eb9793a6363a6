"""The limits command, and the limits that show and simulate print."""

import json

import pytest
from support.configs import with_errors
from support.limits import RATE, ar
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def run(capsys, *arguments):
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_limits_command(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "kalman.fits", lbt.kalman(config.plant))
    table, figure = tmp_path / "l.csv", tmp_path / "l.png"
    status, out, _ = run(capsys, "limits", CONFIG, gain, "-o", table, "-o", figure, "--json")
    assert status == 0
    data = json.loads(out)
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["band_limit_nm"] == pytest.approx(43.8561, abs=1e-4)
    assert data["band_hz"] == [16.5, 23.5]
    rows = {row["design"]: row for row in data["rows"]}
    assert list(rows) == ["integrator", "kalman", "hinf", "kalman (file)"]
    assert rows["kalman"]["residual_nm"] == pytest.approx(rows["kalman (file)"]["residual_nm"])
    assert all(row["above_limit_percent"] > 0 for row in rows.values())
    assert len(table.read_text().splitlines()) == 5
    assert figure.exists()
    status, out, _ = run(capsys, "limits", CONFIG)
    assert status == 0
    assert "above the band limit [%]" in out
    assert "35.02" in out


def test_limits_command_without_vibrations_and_with_coupled_modes(tmp_path, capsys):
    text = with_errors(LBT_YAML.read_text(), 0)
    line = "    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}\n"
    still = tmp_path / "still.yaml"
    still.write_text(text.replace("  vibrations:\n" + line, ""))
    status, out, _ = run(capsys, "limits", still)
    assert status == 0
    assert "worst" not in out
    status, _, error = run(capsys, "limits", still, "-o", tmp_path / "x.png")
    assert status == 2
    assert "a vibration that moves" in error
    coupled = tmp_path / "coupled.yaml"
    more = (
        "    - {kind: resonance, direction_deg: 30, frequency_hz: 20, rms_mas: 80, damping: 0.01}\n"
        "    - {kind: resonance, axis: tip, frequency_hz: 31, rms_mas: 20, damping: 0.01}\n"
    )
    coupled.write_text(text.replace(line, more))
    status, out, _ = run(capsys, "limits", coupled, "--json")
    assert status == 0
    assert json.loads(out)["limit_nm"] is None
    status, out, _ = run(capsys, "limits", coupled)
    assert "cannot be computed" in out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("limits", CONFIG, "-o", "l.txt"), "must end in .csv"),
        (("limits", CONFIG, "none.fits"), "cannot read none.fits"),
        (("limits", "none.yaml"), "cannot read none.yaml"),
        (("limits", CONFIG, "-o", "none/l.csv"), "no directory none"),
    ],
)
def test_limits_command_refuses(tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert text in error
    assert error.count("\n") == 1


def test_show_and_simulate_print_the_limit(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(config.plant))
    data = json.loads(run(capsys, "show", gain, "--json")[1])
    assert data["limit_nm"] == pytest.approx(205.143, abs=1e-3)
    assert abs(data["above_limit_percent"]) < 1e-4
    simulate = ("simulate", CONFIG, gain, "--frames", 200, "--cases", 1)
    data = json.loads(run(capsys, *simulate, "--json")[1])
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["above_limit_percent"] == pytest.approx(35.023, abs=1e-2)
    assert "least of any controller" in run(capsys, *simulate)[1]


def test_show_without_a_limit(tmp_path, capsys):
    """Coupled modes have no limit at a fraction of a frame: a dash, not a failure."""
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50, direction=d)
        for f, d in ((20, (1, 1)), (31, (1, 0)))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        delay_frames=2.4,
        turbulence=ar(0.99, driving=10),
        vibrations=lines,
        noise_nm=5.0,
    )
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(plant))
    assert json.loads(run(capsys, "show", gain, "--json")[1])["limit_nm"] is None
    assert run(capsys, "show", gain)[0] == 0
