"""The command tradeoff."""

from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli.main import main


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
    assert "designed for a delay of 3 frames. Set loop.delay_frames to 3" in capsys.readouterr().err
    assert main(["tradeoff", config, "--points", "201"]) == 2
    assert "points must be at most 200" in capsys.readouterr().err

    def full(**options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert main(["tradeoff", config, "-o", str(tmp_path / "f.png")]) == 2
    assert "takes no new files (No space left on device)" in capsys.readouterr().err
