"""The entry point of ``lbt-synth``: it runs a command and turns errors into exit codes.

Exit status: 0 done, 1 a design or a verification failed, 2 wrong usage or bad input.
Nothing heavy is imported before a command runs.
"""

from __future__ import annotations

import gc
import importlib
import json
import signal
import sys
import threading
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lbt_synth.cli.streams import discard, print_error
from lbt_synth.errors import LbtSynthError, SynthesisError
from lbt_synth.storage.thread_limits import limit_threads

if TYPE_CHECKING:  # slow to import for --help
    from lbt_synth.cli.output import Report

DONE, FAILED, WRONG = 0, 1, 2
_SHARED_MODULES = {
    "completion": "help",
    "end-to-end-table": "end_to_end",
    "verify": "show",
}
INTERRUPTED, BROKEN_PIPE, TERMINATED = 130, 141, 143  # as shells count signals


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what catches an interruption says what is kept."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    named = next((word for word in words if not word.startswith("-")), "")
    from lbt_synth.cli.parser import build_parser

    arguments = build_parser(named).parse_args(words)
    from lbt_synth.storage.display_unit import own_display_unit

    try:
        run = _find_command(arguments.command)
        with _terminable(), own_display_unit():
            report = run(arguments)
    except LbtSynthError as error:
        from lbt_synth.cli.surface import say_error  # after what it says may have failed

        return _fail(error, say_error(error, arguments), arguments)
    except MemoryError:
        print_error("error: not enough memory; ask for less.")
        return WRONG
    except Terminated:
        print_error("terminated")
        return TERMINATED
    except KeyboardInterrupt:
        print_error("interrupted")
        return INTERRUPTED
    report.print(as_json=arguments.json)
    return DONE if report.passed else FAILED


def _find_command(command: str) -> Callable[[Namespace], Report]:
    """Return what runs a command, from its module or from one that it shares."""
    name = command.replace("-", "_")
    module = importlib.import_module(f"lbt_synth.cli.{_SHARED_MODULES.get(command, name)}")
    run: Callable[[Namespace], Report] = getattr(module, f"run_{name}", None) or module.run
    return run


def _fail(error: LbtSynthError, message: str, arguments: Namespace) -> int:
    """Print what failed, and return the exit status."""
    if arguments.json:
        print(json.dumps({"error": type(error).__name__, "message": message}))
    print_error(f"error: {message}")
    return FAILED if isinstance(error, SynthesisError) else WRONG


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM raise an exception where it would end the process at once."""
    if threading.current_thread() is not threading.main_thread():  # which alone may set handlers
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(*_: object) -> None:
    raise Terminated


def entry_point() -> None:
    """Run a command for a shell, and survive closed pipes and full disks."""
    gc.set_threshold(200_000, 50, 50)  # what imports and charts make stays until the end
    for stream in (sys.stdout, sys.stderr):  # no character that an encoding lacks ends a command
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        try:
            with limit_threads():  # numpy is loaded by the commands
                status: int | str | None = main()
        except SystemExit as stop:  # of the parser
            status = stop.code
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        discard(1)
        status = BROKEN_PIPE
    except OSError as error:  # a full disk behind a redirection
        discard(1)
        print_error(f"error: cannot write the output: {error.strerror}.")
        status = WRONG
    try:
        sys.stderr.flush()
    except OSError:
        discard(2)
    gc.freeze()  # Python's exit would look through all of it once more
    sys.exit(status)


if __name__ == "__main__":
    entry_point()
