"""Standard streams that are closed, full or broken, and what must not reach a terminal raw."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys

import pytest
from support.commands import run
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli.main import entry_point
from lbt_synth.cli.output import Report
from lbt_synth.cli.parser import COMMANDS
from lbt_synth.cli.streams import discard, printable

COMMAND = f"{sys.executable} -c 'from lbt_synth.cli.main import entry_point; entry_point()'"
# what is run, its status, and how many lines it writes to standard error
CASES = {
    "--help >&-": (0, 0),
    "none 2>&-": (2, 0),
    "none 2>/dev/full": (2, 0),
    "none >/dev/full 2>/dev/full": (2, 0),
}


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the device is Linux's own")  # noqa: PTH110
@pytest.mark.parametrize("words", CASES)
def test_closed_and_full_streams(words):
    done = subprocess.run(
        ["bash", "-c", f"{COMMAND} {words}"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.count("\n")) == CASES[words]
    assert done.stdout == ""


@pytest.mark.parametrize("as_json", [True, False])
def test_a_broken_pipe_is_not_left_to_rich(monkeypatch, as_json):
    """Rich would end the process with status 1; the entry point makes 141 of the error."""
    reader, writer = os.pipe()
    os.close(reader)
    report = Report(opening=["a line"])
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr("sys.stdout", stream)
        report.print(as_json=as_json)
        with pytest.raises(BrokenPipeError):
            stream.flush()
        discard(writer)
        monkeypatch.undo()


def test_control_characters_are_escaped():
    assert printable("\33[31m\tä\n\x9b\u202e\udcff") == "\\x1b[31m\tä\\n\\x9b\\u202e\\udcff"


@pytest.mark.parametrize("name", ["\33[31mred\n.fits", "\udcff.fits", "\u202e.fits"])
def test_names_of_files_cannot_command_the_terminal(tmp_path, capsys, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    status, _, error = run(capsys, "show", name)
    assert (status, error) == (
        2,
        f"lbt-synth: error: cannot read {printable(name)}: No such file or directory.\n",
    )
    design = lbt.integrator(lbt.load_config(LBT_YAML).hardware, gain=0.4)
    lbt.save_gain(name, design)
    status, out, _ = run(capsys, "sigma", name, "-o", "a.png")
    assert status == 0
    assert printable(name.removesuffix(".fits")) in out
    status, _, error = run(capsys, "design", LBT_YAML, "--method", name, "-o", "a.fits")
    assert status == 2
    for line in (out + error).splitlines():
        assert printable(line) == line


def test_headings_of_records_cannot_command_the_terminal(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("a\33[2J,b\x9b\n1,2\n2,3\n")
    status, _, error = run(capsys, "identify", path, "-o", tmp_path / "a.yaml")
    assert status == 2
    assert "a\\x1b[2J" in error
    assert printable(error) == error.replace("\n", "\\n")


def test_long_values_are_shortened(tmp_path, capsys):
    path = tmp_path / "a.yaml"
    path.write_text(f"version: {'x' * 100_000}\n")
    status, _, error = run(
        capsys, "design", path, "--method", "integrator", "-o", tmp_path / "a.fits"
    )
    assert status == 2
    assert len(error) < 3_000
    assert "characters ...]" in error


def test_the_command_itself_may_be_interrupted(monkeypatch, capsys):
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        monkeypatch.setattr("lbt_synth.cli.show.run", lambda _: os.kill(os.getpid(), signal.SIGINT))
        status, _, error = run(capsys, "show", "none.fits")
    finally:
        signal.signal(signal.SIGINT, before)
    assert (status, error) == (130, "lbt-synth: interrupted\n")


@pytest.mark.parametrize("interruption", [signal.SIG_DFL, signal.SIG_IGN], ids=["heard", "ignored"])
def test_a_termination_says_what_is_kept(monkeypatch, capsys, tmp_path, interruption):
    """Shells ignore interruptions of what runs in the background."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, interruption)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    monkeypatch.setattr(
        "lbt_synth.studies.run_study", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM)
    )
    study = ROOT / "examples" / "study.yaml"
    try:
        status, out, error = run(capsys, "study", study, "-o", tmp_path / "s")
        assert signal.getsignal(signal.SIGINT) == interruption
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert (status, out) == (143, "")
    assert error.splitlines() == [
        f"lbt-synth: what is finished is kept in {tmp_path / 's'}; start it again to continue",
        "lbt-synth: terminated",
    ]


def run_in(monkeypatch, encoding, *words):
    """Status and what both streams got, of a process whose streams have an encoding."""
    streams = [io.BytesIO(), io.BytesIO()]
    wrapped = [io.TextIOWrapper(one, encoding=encoding, newline="\n") for one in streams]
    monkeypatch.setattr(sys, "stdout", wrapped[0])
    monkeypatch.setattr(sys, "stderr", wrapped[1])
    monkeypatch.setattr(sys, "argv", ["lbt-synth", *map(str, words)])
    monkeypatch.setenv("COLUMNS", "40")
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        entry_point()
    except SystemExit as stop:
        status = stop.code
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for one in wrapped:
        one.flush()
    return status, *(stream.getvalue().decode(encoding) for stream in streams)


SAID = {  # what each command does with files that are there, its status, and a part of what it says
    "init": (("-o", "OUT.yaml"), 0, "written: OUT.yaml"),
    "schema": ((), 0, '"frame_rate_hz"'),
    "design": (("CONFIG", "--method", "kalman", "-o", "OUT.fits"), 0, "written: OUT.fits"),
    "show": (("GAIN",), 0, "| quantity"),
    "verify": (("GAIN",), 0, "spectral radius"),
    "export": (("GAIN", "--for", "c", "-o", "OUT.c"), 0, "written: OUT.c"),
    "rehearse": (("GAIN", "--for", "dao"), 2, "Give --record"),
    "sigma": (("GAIN", "-o", "OUT.png"), 0, "written: OUT.png"),
    "bode": (("GAIN", "-o", "OUT.csv"), 0, "written: OUT.csv"),
    "nyquist": (("GAIN",), 0, "modulus margin"),
    "nichols": (("GAIN",), 0, "modulus margin"),
    "step": (("GAIN", "-o", "\u00b1.txt"), 2, "+-.txt"),
    "simulate": (("CONFIG", "GAIN", "--frames", "200", "--cases", "1"), 0, "Strehl"),
    "telemetry": (("NIGHT",), 0, "frame rate"),
    "identify": (("NIGHT", "-o", "\u00b1.txt"), 2, "got '+-.txt'"),
    "auto": (("\u2212.fits", "-o", "OUT.fits"), 2, "cannot read -.fits"),
    "diagnose": (("\u2264.fits",), 2, "cannot read <=.fits"),
    "robustness": (("CONFIG", "GAIN", "--errors-hz", "0", "1", "2"), 0, "Strehl"),
    "tradeoff": (("CONFIG", "--points", "2", "--taps", "2"), 0, "norm"),
    "limits": (("CONFIG", "\u00e9.fits"), 2, "\\xe9.fits"),
    "report": (("CONFIG", "GAIN", "-o", "\u00d7.txt"), 2, "got 'x.txt'"),
    "explore": (("CONFIG", "--port", "70000"), 2, "port"),
    "end-to-end": (("CONFIG", "GAIN", "-o", "GAIN"), 2, "error"),
    "end-to-end-table": (("CONFIG", "GAIN", "-o", "GAIN"), 2, "error"),
    "mirror": (("CONFIG",), 2, "mirror.local_loop"),
    "modal": (("CONFIG", "--modes", "5"), 0, "Kalman"),
    "study": (("none.yaml", "-o", "OUT"), 2, "none.yaml"),
    "paper": (("-o", "GAIN"), 2, "GAIN"),
    "help": (("show",), 0, "usage: lbt-synth show"),
    "completion": (("csh",), 2, "invalid choice"),
}


def test_every_command_is_said_in_any_encoding():
    assert list(SAID) == list(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_ends_on_a_character(tmp_path, monkeypatch, gains, recorded_night, command):
    words, expected, text = SAID[command]
    monkeypatch.chdir(tmp_path)
    places = {
        "CONFIG": LBT_YAML,
        "GAIN": gains["kalman"],
        "NIGHT": recorded_night,
    }
    words = [places.get(word, word) for word in words]
    status, out, error = run_in(monkeypatch, "ascii", command, *words)
    assert status == expected, error
    assert "Traceback" not in error
    assert text.replace("GAIN", str(gains["kalman"])) in " ".join((out + error).split())
    assert (error == "") == (status == 0)


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1"])
def test_characters_that_an_encoding_lacks_become_plain(monkeypatch, encoding):
    status, _, error = run_in(monkeypatch, encoding, "show", "\u22123\u221e\u4e2d.fits")
    assert (status, error) == (
        2,
        "lbt-synth: error: cannot read -3inf\\u4e2d.fits: No such file or directory.\n",
    )
