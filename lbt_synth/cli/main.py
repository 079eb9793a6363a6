"""The entry point of ``lbt-synth``: it runs a command and turns errors into exit codes.

Exit status: 0 done, 1 a design or a verification failed, 2 wrong usage or bad input.
Nothing heavy is imported before a command runs.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence

from lbt_synth.cli.parser import build_parser
from lbt_synth.errors import LbtSynthError, SynthesisError

DONE, FAILED, WRONG = 0, 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    named = next((word for word in words if not word.startswith("-")), "")
    arguments = build_parser(named).parse_args(words)
    from lbt_synth.report.provenance import creation_time  # slow to import for --help

    try:
        creation_time()  # refuses a wrong SOURCE_DATE_EPOCH before the libraries read it
        command = importlib.import_module(f"lbt_synth.cli.{arguments.command.replace('-', '_')}")
        report = command.run(arguments)
    except LbtSynthError as error:
        message = _name_options(str(error), vars(arguments))
        if arguments.json:
            print(json.dumps({"error": type(error).__name__, "message": message}))
        print(f"lbt-synth: error: {message}", file=sys.stderr)
        return FAILED if isinstance(error, SynthesisError) else WRONG
    except MemoryError:
        print("lbt-synth: error: not enough memory; ask for less.", file=sys.stderr)
        return WRONG
    except KeyboardInterrupt:
        print("lbt-synth: interrupted", file=sys.stderr)
        return 130
    report.print(as_json=arguments.json)
    return DONE if report.passed else FAILED


def _name_options(message: str, arguments: Mapping[str, object]) -> str:
    """Name the command's options where a message names arguments of functions.

    With a configuration, a message may name its keys instead.
    """
    if "config" in arguments:
        return message
    words = re.compile(r"(?<![\w.'\"/-])[a-z]+(?:_[a-z]+)+(?!\w|\(|\[|\.\w)")

    def name(found: re.Match[str]) -> str:
        word = found.group()
        return "--" + word.replace("_", "-") if word in arguments else word

    return words.sub(name, message)


def entry_point() -> None:
    """Run the console script, and survive a closed pipe or a full disk."""
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 141
    except OSError as error:  # a full disk behind a redirection
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print(f"lbt-synth: error: cannot write the output: {error.strerror}.", file=sys.stderr)
        status = WRONG
    sys.exit(status)


if __name__ == "__main__":
    entry_point()
