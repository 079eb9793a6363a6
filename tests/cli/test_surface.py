"""Errors speak the words of the terminal: options, and what a file is."""

import pytest
from support.commands import run
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli.surface import file_kind

STUDY = ROOT / "examples" / "study.yaml"
KNOWN = ("--unit", "nm", "--frame-rate-hz", "1000", "--delay-frames", "2")
SAID = [
    (
        ("design", "CONFIG", "--method", "hinf", "--gamma", "1", "-o", "OUT.fits"),
        ("--gamma must be at least 155", "Try --gamma-ratio 1.2."),
    ),
    (
        ("design", "CONFIG", "--method", "mixed", "--rms", "1", "-o", "OUT.fits"),
        ("--rms must be at least 192",),
    ),
    (
        ("design", "CONFIG", "--method", "kalman", "--horizon", "200", "-o", "OUT.fits"),
        ("--horizon must leave the loop", "which makes 201.\n"),
    ),
    (("simulate", "CONFIG", "GAIN", "--cases", "0"), ("--cases must be at least 1",)),
    (("simulate", "CONFIG", "GAIN", "--sensor-gain", "0"), ("--sensor-gain must be above 0",)),
    (("tradeoff", "CONFIG", "--taps", "1000"), ("--taps must be at most 64",)),
    (("modal", "CONFIG", "--modes", "1"), ("--modes must be at least 2",)),
    (
        ("robustness", "CONFIG", "GAIN", "--delay-errors", "-3"),
        ("--delay-errors must be at least -1",),
    ),
    (
        ("robustness", "CONFIG", "GAIN", "--errors-hz", "-30", "1", "3"),
        ("--errors-hz must leave each vibration",),
    ),
    (
        ("end-to-end", "CONFIG", "GAIN", "-o", "OUT", "--pixels", "11"),
        ("--pixels must be even, at least subapertures_across (30)",),
    ),
    (
        ("identify", "BARE.csv", "-o", "OUT.yaml"),
        ("Choose by --columns measurements=... commands=..., names",),
    ),
    (
        ("identify", "NAMED.csv", "-o", "OUT.yaml"),
        (
            "nothing tells the unit of tip, tilt, command_tip, command_tilt: give --unit (nm,",
            "; the frame rate: give --frame-rate-hz, or the times; the total delay: give "
            "--delay-frames.\n",
        ),
    ),
    (
        ("identify", "NAMED.csv", "--unit", "mas", "-o", "OUT.yaml"),
        ("nothing tells the telescope, by which angles become nm: give --diameter-m; the frame",),
    ),
    (
        ("identify", "NAMED.csv", *KNOWN, "--command-unit", "V", "-o", "OUT.yaml"),
        (
            "--command-unit must be one of nm, um",
            "got 'V'. For volts or counts say nm, and give the",
        ),
    ),
    (
        ("identify", "NIGHT", "--unit", "mas", "-o", "OUT.yaml"),
        (
            "--unit must be that of the data, 'nm'; got 'mas'. Leave it out; --show-unit is the unit",
        ),
    ),
    (
        ("simulate", "GAIN", "CONFIG"),
        (
            "GAIN is a gain file, expected a configuration; CONFIG is a "
            "configuration, expected a gain file. Exchange them.\n",
        ),
    ),
    (("simulate", "CONFIG", "NIGHT"), ("NIGHT is telemetry, expected a gain file.\n",)),
    (("identify", "GAIN", "-o", "OUT.yaml"), ("GAIN is a gain file, expected a record.\n",)),
    (("identify", "CONFIG", "-o", "OUT.yaml"), ("is a configuration, expected a record.\n",)),
    (("study", "CONFIG", "-o", "OUT"), ("CONFIG is a configuration, expected a study file.\n",)),
    (("limits", "STUDY"), ("STUDY is a study file, expected a configuration.\n",)),
    (("plot", "sigma", "FIGURE.png", "-o", "OUT.png"), ("is a figure, expected a gain file.\n",)),
]


@pytest.mark.parametrize(("words", "texts"), SAID, ids=lambda words: " ".join(words)[:40])
def test_an_error_names_options_and_files(
    tmp_path, capsys, monkeypatch, gains, recorded_night, words, texts
):
    monkeypatch.chdir(tmp_path)
    rows = "1.0,2.0,0.5,0.25\n2.0,1.0,0.25,0.5\n" * 100
    (tmp_path / "BARE.csv").write_text(rows)
    (tmp_path / "NAMED.csv").write_text("tip,tilt,command_tip,command_tilt\n" + rows)
    (tmp_path / "FIGURE.png").write_bytes(b"")
    places = {"CONFIG": LBT_YAML, "GAIN": gains["kalman"], "NIGHT": recorded_night, "STUDY": STUDY}
    status, out, error = run(capsys, *(places.get(word, word) for word in words))
    assert (status, out, error.count("\n")) == (1 if {"--gamma", "--rms"} & {*words} else 2, "", 1)
    for text in texts:
        for name, path in places.items():
            text = text.replace(f"{name} is", f"{path} is")
        assert text in error


def test_in_python_arguments_keep_their_names():
    plant = lbt.load_config(LBT_YAML).plant
    with pytest.raises(
        lbt.errors.InfeasibleError, match=r"gamma must be .* Try gamma_ratio=1\.2\."
    ):
        lbt.hinf(plant, gamma=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="make an EstimationProblem"):
        lbt.kalman(plant, horizon=200)


def test_kinds_of_files(gains, recorded_night, tmp_path):
    (tmp_path / "a.yaml").write_text("a: [")
    (tmp_path / "b.yaml").write_text("a: 1")
    kinds = {
        LBT_YAML: "configuration",
        STUDY: "study file",
        gains["hinf"]: "gain file",
        recorded_night: "telemetry",
        tmp_path / "a.yaml": "",
        tmp_path / "b.yaml": "",
        tmp_path / "none.fits": "",
        tmp_path / "none.png": "",
    }
    assert {path: file_kind(path) for path in kinds} == kinds
