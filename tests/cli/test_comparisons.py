"""The commands limits, tradeoff and mirror."""

import json

import pytest
from support.configs import with_errors
from support.limits import RATE, ar
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def run_limits(capsys, *arguments):
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_limits_command(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "kalman.fits", lbt.kalman(config.plant))
    table, figure = tmp_path / "l.csv", tmp_path / "l.png"
    status, out, _ = run_limits(capsys, "limits", CONFIG, gain, "-o", table, "-o", figure, "--json")
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
    status, out, _ = run_limits(capsys, "limits", CONFIG)
    assert status == 0
    assert "above the band limit [%]" in out
    assert "35.02" in out


def test_limits_command_without_vibrations_and_with_coupled_modes(tmp_path, capsys):
    text = with_errors(LBT_YAML.read_text(), 0)
    line = "    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}\n"
    still = tmp_path / "still.yaml"
    still.write_text(text.replace("  vibrations:\n" + line, ""))
    status, out, _ = run_limits(capsys, "limits", still)
    assert status == 0
    assert "worst" not in out
    status, _, error = run_limits(capsys, "limits", still, "-o", tmp_path / "x.png")
    assert status == 2
    assert "a vibration that moves" in error
    coupled = tmp_path / "coupled.yaml"
    more = (
        "    - {kind: resonance, direction_deg: 30, frequency_hz: 20, rms_mas: 80, damping: 0.01}\n"
        "    - {kind: resonance, axis: tip, frequency_hz: 31, rms_mas: 20, damping: 0.01}\n"
    )
    coupled.write_text(text.replace(line, more))
    status, out, _ = run_limits(capsys, "limits", coupled, "--json")
    assert status == 0
    assert json.loads(out)["limit_nm"] is None
    status, out, _ = run_limits(capsys, "limits", coupled)
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
    status, out, error = run_limits(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert text in error
    assert error.count("\n") == 1


def test_show_and_simulate_print_the_limit(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(config.plant))
    data = json.loads(run_limits(capsys, "show", gain, "--json")[1])
    assert data["limit_nm"] == pytest.approx(205.143, abs=1e-3)
    assert abs(data["above_limit_percent"]) < 1e-4
    simulate = ("simulate", CONFIG, gain, "--frames", 200, "--cases", 1)
    data = json.loads(run_limits(capsys, *simulate, "--json")[1])
    assert data["limit_nm"] == pytest.approx(37.7777, abs=1e-4)
    assert data["above_limit_percent"] == pytest.approx(35.023, abs=1e-2)
    assert "least of any controller" in run_limits(capsys, *simulate)[1]


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
    assert json.loads(run_limits(capsys, "show", gain, "--json")[1])["limit_nm"] is None
    assert run_limits(capsys, "show", gain)[0] == 0


def test_two_axes_on_the_command_line(tmp_path, capsys):
    assert (
        main(
            [
                "tradeoff",
                str(LBT_YAML),
                "--points",
                "2",
                "-o",
                str(tmp_path / "f.png"),
                "-o",
                str(tmp_path / "f.csv"),
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "the least norm of any filter lies between 155.803" in out
    assert (tmp_path / "f.csv").read_text().splitlines()[
        0
    ] == "family,gamma,gamma_ratio,rms,gain_low,gain_high,modulus"
    assert (tmp_path / "f.png").stat().st_size > 10_000
    for wrong, text in (
        (["tradeoff", str(LBT_YAML), "-o", "f.txt"], "must end in .csv"),
        (["tradeoff", str(LBT_YAML), "--points", "1"], "--points must be at least 2"),
        (["tradeoff", "nowhere.yaml"], "nowhere.yaml"),
        (
            [
                "design",
                str(LBT_YAML),
                "--method",
                "kalman",
                "--rms",
                "200",
                "-o",
                str(tmp_path / "k.fits"),
            ],
            "--rms goes with --method mixed",
        ),
        (
            [
                "design",
                str(LBT_YAML),
                "--method",
                "integrator",
                "--horizon",
                "2",
                "-o",
                str(tmp_path / "k.fits"),
            ],
            "--horizon goes with --method hinf or kalman or mixed; got --method integrator",
        ),
        (
            [
                "design",
                str(LBT_YAML),
                "--method",
                "kalman",
                "--horizon",
                "-3",
                "-o",
                str(tmp_path / "k.fits"),
            ],
            "horizon must leave the loop a delay",
        ),
    ):
        assert main(wrong) == 2
        assert text in capsys.readouterr().err
    target = str(tmp_path / "m.fits")
    assert main(["design", str(LBT_YAML), "--method", "mixed", "--rms", "100", "-o", target]) == 1
    assert "rms must be at least 192.6" in capsys.readouterr().err
    assert (
        main(["design", str(LBT_YAML), "--method", "kalman", "--horizon", "2", "-o", target]) == 0
    )
    assert main(["verify", target]) == 0
    assert lbt.load_gain(target).hardware.delay_frames == 3


def test_what_the_command_line_says_of_mixed_filters(tmp_path, capsys, monkeypatch):
    target = str(tmp_path / "m.fits")
    config = str(LBT_YAML)
    assert main(["design", config, "--method", "mixed", "--gamma", "1e6", "-o", target]) == 0
    assert "no better choice than the Kalman filter" in capsys.readouterr().out
    assert main(["design", config, "--method", "kalman", "--horizon", "2", "-o", target]) == 0
    assert main(["simulate", config, target]) == 1
    said = capsys.readouterr().err
    assert "the closed loop must be stable; got an unstable one" in said
    assert "note: designed for a delay of 3 frames" in said
    assert main(["tradeoff", config, "--points", "201"]) == 2
    assert "points must be at most 200" in capsys.readouterr().err

    def full(**options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert main(["tradeoff", config, "-o", str(tmp_path / "f.png")]) == 2
    assert "takes no new files (No space left on device)" in capsys.readouterr().err


SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


def run_mirror(capsys, *arguments):
    status = main([*map(str, arguments), "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out), captured.err


def test_the_mirror_settles(tmp_path, capsys):
    gain = tmp_path / "lqg.fits"
    status, data, _ = run_mirror(capsys, "design", SLOW_YAML, "--method", "lqg", "-o", gain)
    assert status == 0
    assert data["rms"] > 0
    assert data["limit_nm"] is None  # of a mirror with dynamics, in the image
    assert data["mirror"]["settling_s"] > 3e-3
    assert run_mirror(capsys, "verify", gain)[0] == 0
    assert run_mirror(capsys, "show", gain, "--matrices")[0] == 0
    figure = tmp_path / "m.png"
    table = tmp_path / "m.csv"
    status, data, _ = run_mirror(capsys, "mirror", SLOW_YAML, "-o", figure, "-o", table)
    assert status == 0
    assert figure.stat().st_size > 10_000
    assert table.read_text().count("\n") == 5
    assert [row["stable"] for row in data["rows"]] == [True, False, True, True]
    status, data, _ = run_mirror(capsys, "simulate", SLOW_YAML, gain, "--frames", 500, "--cases", 1)
    assert status == 0
    assert run_mirror(capsys, "plot", "sigma", gain, "-o", tmp_path / "s.png")[0] == 0


def test_wrong_commands_of_mirror(tmp_path, capsys):
    settled = ROOT / "examples" / "lbt.yaml"
    gain = tmp_path / "kalman.fits"
    assert run_mirror(capsys, "design", settled, "--method", "kalman", "-o", gain)[0] == 0
    status, _, err = run_mirror(capsys, "simulate", SLOW_YAML, gain)
    assert status == 1
    assert "designed for a mirror that settles at once, run with a mirror with dynamics" in err
    status, _, err = run_mirror(capsys, "mirror", settled)
    assert status == 2
    assert "mirror.local_loop is missing" in err
    status, _, err = run_mirror(capsys, "mirror", SLOW_YAML, "--tolerance", "2")
    assert status == 2
    assert "tolerance" in err
    for extra, text in (
        (
            ("--horizon", "2"),
            "--horizon goes with --method hinf or kalman or mixed; got --method lqg. Set loop.delay_frames",
        ),
        (("--gain", "1"), "--gain goes"),
        (("--route", "sdp"), "--route goes with --method hinf or kalman; got --method lqg"),
    ):
        status, _, err = run_mirror(
            capsys, "design", SLOW_YAML, "--method", "lqg", *extra, "-o", gain
        )
        assert status == 2
        assert text in err
    status, _, err = run_mirror(
        capsys, "design", settled, "--method", "kalman", "--command-weight", "0.1", "-o", gain
    )
    assert status == 2
    assert "--command-weight goes with --method lqg" in err
