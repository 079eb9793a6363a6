"""The entry point of ``lbt-synth``: it runs a command and turns errors into exit codes.

Exit status: 0 done, 1 a design or a verification failed, 2 wrong usage or bad input.
Nothing heavy is imported for help.

Errors name the arguments of functions in three forms: ``name=value``, a name before "must" or after
"give", and names of several words. The option of the command that has such a name is said instead.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import signal
import sys
import threading
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lbt_synth.cli.arguments import COMMANDS, build_parser, command_options
from lbt_synth.cli.streams import discard, print_error, show_progress
from lbt_synth.errors import ConfigError, LbtSynthError, SynthesisError
from lbt_synth.storage.display_unit import own_display_unit
from lbt_synth.storage.executors import limit_threads

DONE, FAILED, WRONG = 0, 1, 2
INTERRUPTED, BROKEN_PIPE, TERMINATED = 130, 141, 143  # as shells count signals
_WORD = r"[a-z]+(?:_[a-z]+)*"
_VALUE = r"""\{[^}]*\}|'[^']*'|"[^"]*"|-?\w(?:[\w.+-]*\w)?"""
_SETTING = re.compile(rf"""(?<![\w.'"/-])({_WORD})=({_VALUE})""")
_NAME = re.compile(
    rf"(?<![\w.'\"/-])(?:(?:(?<=^)|(?<=: )|(?<=; )){_WORD}(?= must )|(?<=give ){_WORD}"
    r"|[a-z]+(?:_[a-z]+)+)(?!\w|=|\(|\[|\.\w)"
)


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what catches an interruption says what is kept."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    named = next((word for word in words if not word.startswith("-")), "")
    arguments = build_parser(named).parse_args(words)
    try:
        quiet = arguments.json or arguments.command == "explore"  # which prints while it runs
        with _terminable(), own_display_unit(), show_progress(arguments.command, quiet=quiet):
            from lbt_synth.cli.output import run_with_outputs  # slow to import for --help

            report = run_with_outputs(_find_command(arguments.command), arguments)
    except LbtSynthError as error:
        return _fail(error, _say_error(error, arguments), arguments)
    except MemoryError:
        print_error("error: not enough memory; ask for less.")
        return WRONG
    except Terminated:
        print_error("terminated")
        return TERMINATED
    except KeyboardInterrupt:
        print_error("interrupted")
        return INTERRUPTED
    report.print(as_json=arguments.json, verbose=arguments.verbose)
    return DONE if report.passed else FAILED


def _find_command(command: str) -> Any:
    """Return what runs a command, from its module."""
    module = importlib.import_module(f"lbt_synth.cli.{COMMANDS[command].module}")
    return getattr(module, f"run_{command.replace('-', '_')}")


def _fail(error: LbtSynthError, message: str, arguments: Namespace) -> int:
    if arguments.json:
        print(json.dumps({"error": type(error).__name__, "message": message}))
    print_error(f"error: {message}")
    return FAILED if isinstance(error, SynthesisError) else WRONG


def _say_error(error: LbtSynthError, arguments: Namespace) -> str:
    """Return the message of an error in the words of a command that was run."""
    message = str(error)
    cause: BaseException | None = error
    while cause is not None:
        if advice := getattr(cause, "in_python", ""):
            message = message.replace(f" {advice}", "")
        if advice := getattr(cause, "at_terminal", ""):
            message = f"{message} {advice}"
        cause = cause.__cause__
    return message if isinstance(error, ConfigError) else _say_names(message, arguments)


def _say_names(message: str, arguments: Namespace) -> str:
    """Name options where a message names arguments of functions."""
    options = {name: said for name, (said, _) in command_options(arguments.command).items()}

    def name(match: re.Match[str]) -> str:
        return options.get(match[0], match[0])

    def setting(match: re.Match[str]) -> str:
        word, value = match.groups()
        if word not in options:
            return match[0]
        pairs = re.findall(r"'(\w+)': ([^,}]+)", value)
        words = [f"{key}={entry}" for key, entry in pairs] or [value.strip("'\"")]
        return " ".join([options[word], *words])

    return _NAME.sub(name, _SETTING.sub(setting, message))


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
    for name in ("stdout", "stderr"):  # no character that an encoding lacks ends a command
        stream = getattr(sys, name) or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")  # if closed
        stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, stream)
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
    sys.exit(status)


if __name__ == "__main__":
    entry_point()
