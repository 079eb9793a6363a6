"""Ctrl-C ends the console script without a traceback, whenever it comes."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from support.commands import hear_interruptions

PRESS = "os.kill(os.getpid(), _signal.SIGINT)"
AS_IT_LOADS = f"""
class Press:
    def find_spec(self, name, *_):
        if name == MODULE:
            {PRESS}
sys.meta_path.insert(0, Press())
"""
AS_IT_PRINTS = f"""
import lbt_synth.cli.show as show
class Report:
    def print(self, **_):
        {PRESS}
show.run = lambda _: Report()
"""
SCRIPT = "from lbt_synth.cli.script import entry_point; entry_point()"


def python(code):
    code = f"import _signal, os, sys; sys.argv = ['lbt-synth', 'show', 'none.fits']\n{code}"
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=hear_interruptions,
    )


def test_nothing_is_imported_before_interruptions_are_safe():
    done = python(
        "before = set(sys.modules); import lbt_synth.cli.script;"
        "print(*sorted(set(sys.modules) - before))"
    )
    assert done.stdout.split() == ["lbt_synth", "lbt_synth.cli", "lbt_synth.cli.script"]


@pytest.mark.parametrize(
    "press",
    [
        AS_IT_LOADS.replace("MODULE", "'lbt_synth.cli.main'"),
        AS_IT_LOADS.replace("MODULE", "'lbt_synth.cli.show'"),
        AS_IT_PRINTS,
    ],
    ids=["as the command line loads", "as the command loads", "as the report is printed"],
)
def test_an_interruption_ends_the_process_at_once(press):
    done = python(press + SCRIPT)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_an_ignored_interruption_stays_ignored():
    """A shell without job control ignores it for what runs in the background."""
    done = python(
        f"_signal.signal(_signal.SIGINT, _signal.SIG_IGN)\n{AS_IT_PRINTS}"
        "Report.passed = True\n" + SCRIPT
    )
    assert (done.returncode, done.stderr) == (0, "")
