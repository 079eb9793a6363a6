"""The command auto: good records, and bad ones."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.commands import run
from support.night import GAIN, NOISE
from support.recorded_loops import spliced_record

import lbt_synth as lbt


@pytest.fixture(scope="module")
def made(recorded_night, tmp_path_factory):
    """Everything that auto writes, and what it says."""
    import contextlib
    import io

    from lbt_synth.cli.main import main

    out = tmp_path_factory.mktemp("auto") / "tt.fits"
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(["auto", str(recorded_night), "-o", str(out), "--json"]) == 0
    return out, json.loads(text.getvalue())


def test_auto_tests_its_design_on_unseen_data(made, recorded_loop):
    out, data = made
    rows = {row["name"]: row for row in data["held_out"]}
    assert list(rows) == [
        "what ran",
        "best integrator",
        "Kalman filter",
        "H-infinity filter",
        "LQG controller",
        "least-squares predictor",
        "limit of performance",
    ]
    kalman = rows["Kalman filter"]
    assert kalman["data_nm"] < 0.5 * rows["what ran"]["data_nm"]
    assert kalman["data_nm"] < 1.02 * rows["least-squares predictor"]["data_nm"]
    assert kalman["data_nm"] == pytest.approx(kalman["model_nm"], rel=0.1)
    # what ran is what the simulation left in its second half
    run_, _, _ = recorded_loop
    half = run_.residual_nm[0, len(run_.residual_nm[0]) // 2 :]
    true = np.sqrt(np.sum(np.mean(half**2, axis=0)))
    gain = data["axes"][0]["sensor_gain"]
    assert rows["what ran"]["data_nm"] == pytest.approx(true * GAIN / gain, rel=0.05)
    assert data["gain_over_what_ran"]["residual_nm"][1] == kalman["data_nm"]
    assert data["certificate"] is True
    assert data["method"] == "kalman"
    assert data["units"]["data_error_nm"] == "nm"
    assert lbt.load_gain(out).certificate.passed
    assert lbt.load_config(data["model"]).plant.vibrations
    assert out.with_suffix(".png").is_file()


def test_auto_says_what_it_found(capsys, recorded_night, tmp_path):
    out = tmp_path / "h.npz"
    status, text, error = run(
        capsys,
        "auto",
        recorded_night,
        "-o",
        out,
        "--method",
        "hinf",
        "--gamma-ratio",
        1.3,
        "--no-figure",
        "--model",
        tmp_path / "m.yml",
        "--sensor-gain",
        GAIN,
    )
    assert (status, error) == (0, "")
    assert re.search(r"gain over what ran, on unseen data: [\d.]+ \+- [\d.]+ nm -> ", text)
    assert "sensor gain given." in text
    assert "H-infinity filter" in text
    assert "Kalman filter" not in text
    assert not (tmp_path / "h.png").exists()
    assert (tmp_path / "m.yml").is_file()


def test_an_open_loop_series_and_one_axis(tmp_path, capsys, recorded_loop):
    run_, _, _ = recorded_loop
    file = tmp_path / "open.npy"
    noise = np.random.default_rng(0).standard_normal(len(run_.total_nm[0]))
    np.save(file, run_.total_nm[0][:, 0] + NOISE * noise)
    status, text, error = run(
        capsys,
        "auto",
        file,
        "-o",
        tmp_path / "t.fits",
        "--kind",
        "open-loop",
        "--frame-rate-hz",
        1000,
        "--delay-frames",
        2,
        "--unit",
        "nm",
        "--no-figure",
    )
    assert (status, error) == (0, "")
    assert "what ran" not in text
    assert "H-infinity filter" in text
    assert "note: the Kalman filter stays: " in text
    assert lbt.load_config(tmp_path / "t.yaml").plant.hardware.modes == 1


def test_auto_refuses_what_it_cannot_do(tmp_path, capsys, recorded_night):
    for options, words in (
        (("-o", tmp_path / "t.fits", "--gamma-ratio", 0.5), "--gamma-ratio must be at least 1"),
        (
            ("-o", tmp_path / "t.fits", "--method", "kalman", "--gamma-ratio", 1.1),
            "--gamma-ratio goes with method hinf or mixed; got method kalman",
        ),
        (("-o", tmp_path / "t.fits", "--lines-hz", "nan"), "--lines-hz must be finite; got nan"),
        (("-o", tmp_path / "t.fits", "--lines-hz", 12, "-5"), "--lines-hz must be above 0; got -5"),
        (("-o", tmp_path / "t.txt"), "must end in"),
        (("-o", tmp_path / "t.fits", "--model", tmp_path / "t.fits"), "must end in .yaml"),
        (("-o", tmp_path / "t.fits", "--model", tmp_path / "t.json"), "must end in .yaml"),
    ):
        status, _, error = run(capsys, "auto", recorded_night, *options)
        assert status == 2
        assert words in error
    assert list(tmp_path.iterdir()) == []


def test_a_short_record_is_refused_in_the_words_of_the_command_line(tmp_path, capsys) -> None:
    record, file = spliced_record(frames=3000), tmp_path / "brief.npz"
    np.savez(file, measurements=record.measurements, commands=record.commands)
    known = ("--frame-rate-hz", 1000, "--unit", "nm", "--no-figure", "-o", tmp_path / "q.fits")
    for options, message in (
        (
            ("--delay-frames", 2),
            "the record needs 4000 usable frames (4 s at 1000 Hz) in stretches of at least 256; "
            "got 2996 (3 s), the longest stretch 2996.",
        ),
        (("--delay-frames", 0.2), "--delay-frames must be"),
        ((), "not known; give --delay-frames, from the middle"),
    ):
        status, text, error = run(capsys, "auto", file, *known, *options)
        assert (status, text) == (2, "")
        assert message in error
        assert not any(name in error for name in ("_frames", "record.", "bridged", "settle"))
    assert list(tmp_path.iterdir()) == [file]


def test_names_that_no_text_can_hold(tmp_path, capsys) -> None:
    record = spliced_record(frames=9000)
    file = tmp_path / "a\x01.npz"
    np.savez(file, measurements=record.measurements, commands=record.commands)
    status, text, error = run(
        capsys,
        "auto",
        file,
        "-o",
        tmp_path / "q.fits",
        "--frame-rate-hz",
        1000,
        "--delay-frames",
        2,
        "--unit",
        "nm",
        "--no-figure",
    )
    assert (status, error) == (0, "")
    assert "a\\x01.npz" in (tmp_path / "q.yaml").read_text()
    assert "note: the record is short (9 s): it does not tell lines less than 0.11 Hz apart" in text
    assert "Half a minute shows more" in text
