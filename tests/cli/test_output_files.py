"""No command replaces a file that it reads, by whatever name or link it is given."""

import os
import shutil

import pytest
from support.commands import run
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli.parser import COMMANDS

READ_ONLY = {"show", "verify"}  # they write nothing


WITHOUT_INPUTS = {"paper", "init", "completion", "explore"}


# Inputs by their names in a directory, and arguments; OUT is where the output goes, under the
# name of the input that it would replace.
CASES = {
    "design": ("config.yaml", "config.yaml --method integrator -o OUT.fits"),
    "export mat": ("gain.fits", "gain.fits --for matlab -o OUT.mat"),
    "export dao": ("gain.fits", "gain.fits --for dao -o OUT.fits"),
    "export c": ("gain.fits", "gain.fits --for c -o OUT.c"),
    "export pyrtc": ("gain.fits", "gain.fits --for pyrtc -o .", "config.yaml.certificate.json"),
    "export c header": ("gain.fits", "gain.fits --for c -o other.c", "other.h"),
    "rehearse": ("gain.fits", "gain.fits --for dao -o OUT.png"),
    "rehearse record": ("series.fits", "gain.fits --for dao --record series.fits -o OUT.pdf"),
    "plot sigma": ("gain.fits", "sigma gain.fits -o OUT.png"),
    "plot bode": ("gain.fits", "bode gain.fits -o OUT.png"),
    "plot nyquist": ("gain.fits", "nyquist gain.fits -o a.csv -o OUT.png"),
    "plot nichols": ("gain.fits", "nichols gain.fits -o OUT.pdf"),
    "plot step": ("gain.fits", "step gain.fits -o OUT.csv"),
    "simulate": ("gain.fits", "config.yaml gain.fits -o OUT.png"),
    "simulate config": ("config.yaml", "config.yaml gain.fits -o OUT.png"),
    "simulate telemetry": ("gain.fits", "config.yaml gain.fits --frames 50 --telemetry OUT.fits"),
    "telemetry": ("series.fits", "series.fits -o OUT.fits"),
    "auto": ("series.fits", "series.fits -o OUT.fits"),
    "diagnose": ("series.fits", "series.fits -o OUT.html"),
    "diagnose pdf": ("series.fits", "series.fits -o a.html --pdf OUT.pdf"),
    "diagnose gain": ("gain.fits", "series.fits gain.fits -o OUT.html"),
    "identify": ("series.fits", "series.fits -o a.yaml --figure OUT.png"),
    "identify commands": ("config.yaml", "series.fits --commands config.yaml -o OUT.yaml"),
    "robustness": ("config.yaml", "config.yaml -o OUT.csv"),
    "robustness gain": ("gain.fits", "config.yaml gain.fits -o a.csv -o OUT.png"),
    "report": ("gain.fits", "config.yaml gain.fits -o OUT.html"),
    "report config": ("config.yaml", "config.yaml gain.fits -o OUT.html"),
    "report pdf": ("gain.fits", "config.yaml gain.fits -o a.html --pdf OUT.pdf"),
    "tradeoff": ("config.yaml", "config.yaml -o OUT.csv"),
    "limits": ("config.yaml", "config.yaml -o OUT.csv"),
    "limits gain": ("gain.fits", "config.yaml gain.fits -o OUT.pdf"),
    "mirror": ("config.yaml", "config.yaml -o OUT.png"),
    "modal": ("config.yaml", "config.yaml -o OUT.csv"),
    "end-to-end": ("gain.fits", "config.yaml gain.fits -o .", "telemetry.fits"),
    "end-to-end config": ("config.yaml", "config.yaml gain.fits -o .", "summary.json"),
    "study": ("config.yaml", "study.yaml -o .", "a.fits"),
    "study configuration": ("config.yaml", "study.yaml -o .", "results.csv"),
    "study file": ("study.yaml", "study.yaml -o .", "summary.html"),
    "study row": ("config.yaml", "study.yaml -o . --row 3", "row_3.yaml"),
    "end-to-end-table": ("gain.fits", "config.yaml gain.fits -o .", "table_ii.csv"),
    "end-to-end-table config": ("config.yaml", "config.yaml -o .", "table_iii.pdf"),
}


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    shutil.copy(LBT_YAML, folder / "config.yaml")
    (folder / "study.yaml").write_text(
        "version: 1\nconfig: config.yaml\nsamples: 4\nparameters: {loop.delay_frames: 2.5}\n"
        "controllers: {a: {design: integrator, gain: 0.4}, b: {file: gain.fits}}\n"
    )
    design = lbt.integrator(lbt.load_config(LBT_YAML).hardware, gain=0.4)
    lbt.save_gain(folder / "gain.fits", design)
    series = lbt.files.Telemetry(
        frame_rate_hz=800, commands=[[0.0, 1.0]], measurements=[[3.0, 2.0]]
    )
    lbt.files.save_telemetry(folder / "series.fits", series)
    return folder


def test_every_command_that_writes_is_here():
    assert {case.split()[0] for case in CASES} | READ_ONLY | WITHOUT_INPUTS == set(COMMANDS)


@pytest.mark.parametrize("link", [os.symlink, os.link], ids=["symbolic link", "hard link"])
@pytest.mark.parametrize("case", CASES)
def test_an_output_that_is_an_input_is_refused(
    tmp_path, capsys, monkeypatch, originals, case, link
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(originals, tmp_path, dirs_exist_ok=True)
    source, words, *target = CASES[case]
    arguments = words.split()
    taken = target[0] if target else next(a for a in arguments if a.startswith("OUT"))
    link(tmp_path / source, tmp_path / taken)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    status, out, error = run(capsys, case.split()[0], *arguments)
    assert (status, out) == (2, "")
    assert f"must not replace the input {source}" in error
    assert error.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert (tmp_path / taken).samefile(source)


@pytest.mark.parametrize(
    ("command", "arguments", "source"),
    [
        ("export", ("gain.fits", "--for", "dao", "-o", "gain.fits"), "gain.fits"),
        ("simulate", ("config.yaml", "gain.fits", "--telemetry", "./gain.fits"), "gain.fits"),
        ("telemetry", ("series.fits", "-o", "../DIR/series.fits"), "series.fits"),
        pytest.param(
            *("telemetry", ("series.fits", "--format", "aot", "-o", "series.fits"), "series.fits"),
            marks=pytest.mark.e2e,
        ),
    ],
)
def test_the_same_file_by_its_name(
    tmp_path, capsys, monkeypatch, originals, command, arguments, source
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(originals, tmp_path, dirs_exist_ok=True)
    before = (tmp_path / source).read_bytes()
    status, _, error = run(capsys, command, *(a.replace("DIR", tmp_path.name) for a in arguments))
    assert status == 2
    assert f"must not replace the input {source}" in error
    assert (tmp_path / source).read_bytes() == before
