"""Standard streams that are full or broken, and what must not reach a terminal raw."""

import io
import os
import shutil
import signal
import subprocess
import sys
from signal import default_int_handler

import pytest
from support.commands import refuse_commands, run, run_done
from support.plants import LBT_YAML, ROOT
from support.refusals import refused

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


def test_a_broken_pipe_is_not_left_to_rich(monkeypatch):
    """Rich would end the process with status 1; the entry point makes 141 of the error."""
    for as_json in (True, False):
        reader, writer = os.pipe()
        os.close(reader)
        with os.fdopen(writer, "w") as stream, monkeypatch.context() as patch:
            patch.setattr("sys.stdout", stream)
            Report(verdict=["a line"]).print(as_json=as_json)
            refused(stream.flush, BrokenPipeError, None)
            discard(writer)


def test_names_of_files_cannot_command_the_terminal(tmp_path, capsys, monkeypatch, gains):
    monkeypatch.chdir(tmp_path)
    assert printable("\33[31m\tä\n\x9b\u202e\udcff") == "\\x1b[31m\tä\\n\\x9b\\u202e\\udcff"
    for name in ("\33[31mred\n.fits", "\udcff.fits", "\u202e.fits"):
        missing = f"error: cannot read {printable(name)}: No such file or directory."
        refuse_commands(capsys, [(f"show {name}", missing)])
        shutil.copy(gains["integrator"], name)
        out = run_done(capsys, "plot", "step", name)
        assert printable(name.removesuffix(".fits")) in out
        status, _, error = run(capsys, "design", LBT_YAML, "--method", name, "-o", "a.fits")
        assert status == 2
        assert all(printable(line) == line for line in (out + error).splitlines())


SIGNALS = [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]


@pytest.mark.parametrize(("number", "status", "word"), SIGNALS)
def test_a_signal_says_what_is_kept(monkeypatch, capsys, tmp_path, number, status, word):
    stop = lambda *_, **__: signal.raise_signal(number)  # noqa: E731
    for call in ("lbt_synth.cli.design.run_show", "lbt_synth.studies.run_study"):
        monkeypatch.setattr(call, stop)
    # shells may ignore an interruption
    before = signal.getsignal(signal.SIGTERM), signal.signal(signal.SIGINT, default_int_handler)
    end = f"lbt-synth: {word}\n"
    kept = f"lbt-synth: what is finished is kept in {tmp_path / 's'}; start it again to continue\n"
    study = ROOT / "examples" / "study.yaml"
    try:
        assert run(capsys, "show", "none.fits") == (status, "", end)
        assert run(capsys, "study", study, "-o", tmp_path / "s") == (status, "", kept + end)
        assert signal.getsignal(signal.SIGTERM) == before[0]
    finally:
        signal.signal(signal.SIGINT, before[1])


def run_in(monkeypatch, encoding, *words):
    """Status and what both streams got, of a process whose streams have an encoding."""
    streams = [io.BytesIO(), io.BytesIO()]
    wrapped = [io.TextIOWrapper(one, encoding=encoding, newline="\n") for one in streams]
    for name, value in (("stdout", wrapped[0]), ("stderr", wrapped[1]), ("argv", ["", *words])):
        monkeypatch.setattr(sys, name, value)
    monkeypatch.setenv("COLUMNS", "40")
    stop = refused(entry_point, SystemExit, None)
    for one in wrapped:
        one.flush()
    return stop.code, *(stream.getvalue().decode(encoding) for stream in streams)


def test_characters_that_an_encoding_lacks_are_escaped(monkeypatch, gains):
    missing = "lbt-synth: error: cannot read 3\\u221e.fits: No such file or directory.\n"
    assert run_in(monkeypatch, "ascii", "show", "3\u221e.fits") == (2, "", missing)
    status, out, error = run_in(monkeypatch, "ascii", "show", str(gains["kalman"]))
    assert (status, error, "\\u" in out) == (0, "", False)
    assert all(word in out for word in ("\n  quantity", "\n -----"))


def test_a_shell_may_close_the_output(monkeypatch, gains):
    for name, value in (("stdout", None), ("argv", ["", "show", str(gains["kalman"])])):
        monkeypatch.setattr(sys, name, value)
    assert refused(entry_point, SystemExit, None).code == 0
    sys.stdout.close()  # of nothing


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("quiet", [False, True])
def test_only_a_terminal_shows_what_is_done(capsys, monkeypatch, terminal, quiet):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    with streams.show_progress("thinking", quiet=quiet):
        with streams.count_progress(total=8, what="runs") as count:
            count(3)
        assert list(streams.track_progress(range(2), total=2, what="rows")) == [0, 1]
    error = capsys.readouterr().err
    assert "thinking" in error if terminal and not quiet else error == ""
