"""Commands of ``lbt-synth``, run in the process of the tests."""

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
