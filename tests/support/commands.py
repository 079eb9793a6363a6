"""Commands of ``lbt-synth``, run in the process of the tests."""

import json
import signal

from lbt_synth.cli.main import main


def hear_interruptions():
    """Let a new process be interrupted where the tests run in a background that ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run(capsys, *arguments):
    """Exit status, standard output and standard error of one command."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:  # argparse
        status = stop.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def run_done(capsys, *arguments):
    """Standard output of a command that has nothing to complain about."""
    status, text, error = run(capsys, *arguments)
    assert (status, error) == (0, ""), error
    return text


def run_json(capsys, *arguments):
    return json.loads(run_done(capsys, *arguments, "--json"))


def refuse_commands(capsys, rows, **places):
    """Run each row of (words, message): one line, no output. Names in capitals are places."""
    for words, message in rows:
        named = [places.get(word, word) for word in words.split(" ")]
        status, out, error = run(capsys, *named)
        assert (status, out, error.count("\n")) == (2, "", 1), error
        assert message in error, error
