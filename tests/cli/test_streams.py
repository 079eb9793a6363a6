"""Standard streams that are full or broken, and what must not reach a terminal raw."""

import io
import os
import signal
import subprocess
import sys

import pytest
from support.commands import refuse_commands, run, run_done
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli import streams
from lbt_synth.cli.main import entry_point
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import discard, printable

COMMAND = f"{sys.executable} -c 'from lbt_synth.cli.main import entry_point; entry_point()'"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the device is Linux's own")  # noqa: PTH110
@pytest.mark.parametrize("words", ["none 2>/dev/full", "none >/dev/full 2>/dev/full"])
def test_full_streams(words):
    words = ["bash", "-c", f"{COMMAND} {words}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


@pytest.mark.parametrize("as_json", [True, False])
def test_a_broken_pipe_is_not_left_to_rich(monkeypatch, as_json):
    """Rich would end the process with status 1; the entry point makes 141 of the error."""
    reader, writer = os.pipe()
    os.close(reader)
    report = Report(verdict=["a line"])
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr("sys.stdout", stream)
        report.print(as_json=as_json)
        with pytest.raises(BrokenPipeError):
            stream.flush()
        discard(writer)
        monkeypatch.undo()


def test_control_characters_are_escaped():
    assert printable("\33[31m\tä\n\x9b\u202e\udcff") == "\\x1b[31m\tä\\n\\x9b\\u202e\\udcff"


def test_names_of_files_cannot_command_the_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4)
    for name in ("\33[31mred\n.fits", "\udcff.fits", "\u202e.fits"):
        missing = f"error: cannot read {printable(name)}: No such file or directory."
        refuse_commands(capsys, [(f"show {name}", missing)])
        lbt.save_gain(name, design)
        out = run_done(capsys, "plot", "step", name)
        assert printable(name.removesuffix(".fits")) in out
        status, _, error = run(capsys, "design", LBT_YAML, "--method", name, "-o", "a.fits")
        assert status == 2
        assert all(printable(line) == line for line in (out + error).splitlines())


def test_an_interruption_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(
        "lbt_synth.cli.design.run_show", lambda _: signal.raise_signal(signal.SIGINT)
    )
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells may ignore it
    try:
        assert run(capsys, "show", "none.fits") == (130, "", "lbt-synth: interrupted\n")
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_termination_says_what_is_kept(monkeypatch, capsys, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(
        "lbt_synth.studies.run_study", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM)
    )
    study = ROOT / "examples" / "study.yaml"
    status, out, error = run(capsys, "study", study, "-o", tmp_path / "s")
    assert signal.getsignal(signal.SIGTERM) == before
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
    with pytest.raises(SystemExit) as stop:
        entry_point()
    for one in wrapped:
        one.flush()
    return stop.value.code, *(stream.getvalue().decode(encoding) for stream in streams)


def test_characters_that_an_encoding_lacks_are_escaped(monkeypatch, gains):
    assert run_in(monkeypatch, "ascii", "show", "3\u221e.fits") == (
        2,
        "",
        "lbt-synth: error: cannot read 3\\u221e.fits: No such file or directory.\n",
    )
    status, out, error = run_in(monkeypatch, "ascii", "show", gains["kalman"])
    assert (status, error) == (0, "")
    assert "\n  quantity" in out
    assert "\n -----" in out
    assert "\\u" not in out


def show_all(quiet):
    with streams.show_progress("thinking", quiet=quiet):
        with streams.count_progress(total=8, what="runs") as count:
            count(3)
        seen = streams.track_progress(range(2), total=2, what="rows")
        assert list(seen) == [0, 1]


@pytest.mark.parametrize(("terminal", "quiet"), [(False, False), (False, True), (True, True)])
def test_nothing_is_said_to_programs(capsys, monkeypatch, terminal, quiet):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    show_all(quiet)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_what_is_done(capsys, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    show_all(quiet=False)
    assert "thinking" in capsys.readouterr().err
