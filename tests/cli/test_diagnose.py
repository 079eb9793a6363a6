"""The command diagnose: good records, bad ones, and a gain file on them."""

import json

import numpy as np
import pytest
from support.commands import run
from support.diagnoses import given_design, line_record
from support.recorded_loops import RATE

import lbt_synth as lbt

FACTS = ("--frame-rate-hz", RATE, "--delay-frames", 2, "--unit", "nm")


def write(path, change=1.0, frames=None, **more):
    record = line_record()
    y, u = record.measurements[:frames], record.commands[:frames]
    np.savez(path, measurements=y, commands=change * u, **more)
    return path


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    return write(tmp_path_factory.mktemp("records") / "night.npz")


def test_a_page_of_text(capsys, night):
    status, text, error = run(capsys, "diagnose", night, *FACTS)
    assert (status, error) == (0, "")
    lines = text.splitlines()
    assert lines[0].startswith("The record is sound: an integrator of gain 0.2 ran")
    assert lines[2].startswith("First change the controller: the ")
    assert len(lines) < 66
    for caption in (
        "Record: 8.188 s at 1000 Hz. 8186 of 8188 frames are usable",
        "Control law in use, from y to u",
        "Vibrations",
        "What each part leaves by the model of the first half (best design: ",
        "Residual on the second half of the record",
    ):
        assert caption in " ".join(text.split())


def test_a_gain_file_the_page_and_json(capsys, night, tmp_path):
    gain = lbt.save_gain(tmp_path / "mine.npz", given_design())
    page = tmp_path / "page.html"
    status, text, error = run(capsys, "diagnose", night, gain, *FACTS, "-o", page, "--json")
    assert (status, error) == (0, "")
    data = json.loads(text)
    assert data["doubt"] is None
    assert data["control_law"]["kind"] == "integrator"
    assert any(note.startswith("mine promises") for note in data["notes"])
    assert {row["name"] for row in data["residuals"]} > {"mine", data["best"], "what ran"}
    assert data["costs"][-1]["part"] == "all"
    assert data["lines"][0]["frequency_hz"] == pytest.approx(31, abs=0.2)
    assert data["verdict"][0].startswith("The record is sound")
    assert data["files"] == [str(page)]
    assert "Diagnosis of night.npz" in page.read_text(encoding="utf-8")


def test_a_record_that_lies_is_still_diagnosed(capsys, tmp_path):
    status, text, _ = run(capsys, "diagnose", write(tmp_path / "n.npz", -1.0, 3000), *FACTS)
    assert status == 0
    assert text.startswith(
        "The commands are not those that the mirror followed: they have the opposite sign.\n"
        "Nothing can be said of its residual.\nFirst read the record with --command-sign -1.\n"
    )
    assert "-0.2" in text
    assert "Vibrations" not in text


def test_a_dead_axis_leaves_the_other(capsys, tmp_path):
    record = line_record()
    y = np.hstack([record.measurements, np.zeros((record.frames, 1))])
    path = tmp_path / "dead.npz"
    np.savez(path, measurements=y, commands=np.hstack([record.commands] * 2))
    status, text, _ = run(capsys, "diagnose", path, *FACTS)
    assert status == 0
    assert text.startswith("The record has faults: the tilt measurement is dead.\nIt leaves ")
    assert "note: the rest is of the axis that lives: the other one is dead" in text


def test_the_clock(capsys, tmp_path):
    record = line_record()
    jitter = 2e-5 * np.random.default_rng(0).standard_normal(record.frames)
    kept = np.ones(record.frames, dtype=bool)
    kept[100::800] = False
    write_times = np.arange(record.frames) / RATE + jitter
    path = tmp_path / "clock.npz"
    np.savez(
        path,
        times_s=write_times[kept],
        measurements=record.measurements[kept],
        commands=record.commands[kept],
    )
    status, text, _ = run(capsys, "diagnose", path, "--delay-frames", 2, "--unit", "nm")
    assert status == 0
    assert "clock jitter 0.02 frames rms" in " ".join(text.split())
    assert "11 missing (frames)" in " ".join(text.split())


def test_bad_input(capsys, night, tmp_path):
    def error_of(*arguments):
        status, _, error = run(capsys, "diagnose", *arguments)
        assert status == 2
        (line,) = error.splitlines()
        return line.removeprefix("lbt-synth: error: ")

    assert error_of(night, *FACTS[:2], *FACTS[4:]).startswith("the total delay of this loop is not")
    assert "cannot read" in error_of(night, tmp_path / "no.fits", *FACTS)
    assert ".html" in error_of(night, *FACTS, "-o", tmp_path / "page.txt")
    assert error_of(night, *FACTS, "--pdf", "a.pdf").startswith("--pdf is the page of -o on paper")
    assert "npz" in error_of(tmp_path / "nowhere.npz", *FACTS)
    spectrum = tmp_path / "psd.csv"
    f = np.arange(1.0, 200)
    np.savetxt(
        spectrum, np.column_stack([f, 1 / f]), delimiter=",", header="frequency_hz,psd", comments=""
    )
    assert error_of(spectrum, "--kind", "spectrum", "--unit", "nm^2/Hz").startswith(
        "diagnose examines recorded series; got a spectrum."
    )
