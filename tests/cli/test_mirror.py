"""The command mirror."""

import json

from support.plants import ROOT

from lbt_synth.cli.main import main

SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


def run(capsys, *arguments):
    status = main([*map(str, arguments), "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out), captured.err


def test_commands(tmp_path, capsys):
    gain = tmp_path / "lqg.fits"
    status, data, _ = run(capsys, "design", SLOW_YAML, "--method", "lqg", "-o", gain)
    assert status == 0
    assert data["rms"] > 0
    assert data["limit_nm"] is None  # of a mirror with dynamics, in the image
    assert data["mirror"]["settling_s"] > 3e-3
    assert run(capsys, "verify", gain)[0] == 0
    assert run(capsys, "show", gain, "--matrices")[0] == 0
    figure = tmp_path / "m.png"
    table = tmp_path / "m.csv"
    status, data, _ = run(capsys, "mirror", SLOW_YAML, "-o", figure, "-o", table)
    assert status == 0
    assert figure.stat().st_size > 10_000
    assert table.read_text().count("\n") == 5
    assert [row["stable"] for row in data["rows"]] == [True, False, True, True]
    status, data, _ = run(capsys, "simulate", SLOW_YAML, gain, "--frames", 500, "--cases", 1)
    assert status == 0
    assert run(capsys, "plot", "sigma", gain, "-o", tmp_path / "s.png")[0] == 0


def test_wrong_commands(tmp_path, capsys):
    settled = ROOT / "examples" / "lbt.yaml"
    gain = tmp_path / "kalman.fits"
    assert run(capsys, "design", settled, "--method", "kalman", "-o", gain)[0] == 0
    status, _, err = run(capsys, "simulate", SLOW_YAML, gain)
    assert status == 1
    assert "another mirror" in err
    status, _, err = run(capsys, "mirror", settled)
    assert status == 2
    assert "mirror.local_loop is missing" in err
    status, _, err = run(capsys, "mirror", SLOW_YAML, "--tolerance", "2")
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
        status, _, err = run(capsys, "design", SLOW_YAML, "--method", "lqg", *extra, "-o", gain)
        assert status == 2
        assert text in err
    status, _, err = run(
        capsys, "design", settled, "--method", "kalman", "--command-weight", "0.1", "-o", gain
    )
    assert status == 2
    assert "--command-weight goes with --method lqg" in err
