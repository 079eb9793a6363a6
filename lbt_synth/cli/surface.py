"""Errors in the words of the terminal: options for arguments, and what a file is.

Messages name the arguments of functions in three forms: ``name=value``, a name before "must" or
after "give", and names of several words. The option of the command that has such a name is said
instead.
"""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.parser import command_options
from lbt_synth.config.load import read_mapping
from lbt_synth.errors import ConfigError, LbtSynthError, OutputError
from lbt_synth.files import load_gain
from lbt_synth.identification.records.from_file import is_telemetry

_WORD = r"[a-z]+(?:_[a-z]+)*"
_VALUE = r"""\{[^}]*\}|'[^']*'|"[^"]*"|-?\w(?:[\w.+-]*\w)?"""
_SETTING = re.compile(rf"""(?<![\w.'"/-])({_WORD})=({_VALUE})""")
_NAME = re.compile(
    rf"(?<![\w.'\"/-])(?:(?:(?<=^)|(?<=: )|(?<=; )){_WORD}(?= must )|(?<=give ){_WORD}"
    r"|[a-z]+(?:_[a-z]+)+)(?!\w|=|\(|\[|\.\w)"
)
_CONFIGURATION, _GAIN, _STUDY, _TELEMETRY = "configuration", "gain file", "study file", "telemetry"
_RECORD = "record"  # telemetry, or what no other kind is
_EXPECTED = {"config": _CONFIGURATION, "gain": _GAIN, "gains": _GAIN, "study": _STUDY}
_EXPECTED |= dict.fromkeys(("file", "files", "source"), _RECORD)
_ENDINGS = {".png": "figure", ".pdf": "figure", ".svg": "figure", ".html": "page"}


def say_error(error: LbtSynthError, arguments: Namespace) -> str:
    """Return the message of an error in the words of a command that was run."""
    if not isinstance(error, OutputError) and (misplaced := _misplaced_files(arguments)):
        return misplaced
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

    def name(found: re.Match[str]) -> str:
        return options.get(found[0], found[0])

    def setting(found: re.Match[str]) -> str:
        word, value = found.groups()
        if word not in options:
            return found[0]
        pairs = re.findall(r"'(\w+)': ([^,}]+)", value)
        words = [f"{key}={entry}" for key, entry in pairs] or [value.strip("'\"")]
        return " ".join([options[word], *words])

    return _NAME.sub(name, _SETTING.sub(setting, message))


def _misplaced_files(arguments: Namespace) -> str:
    """Return which files of a command are of another kind than they stand for, if any are."""
    wrong = [
        (path, kind, wanted)
        for place, wanted in _EXPECTED.items()
        for path in _as_list(getattr(arguments, place, None))
        if (kind := file_kind(Path(path))) not in ("", wanted)
        and (kind, wanted) != (_TELEMETRY, _RECORD)
    ]
    text = "; ".join(f"{path} is a {kind}, expected a {wanted}" for path, kind, wanted in wrong)
    text = text.replace("is a telemetry", "is telemetry")
    exchanged = len(wrong) == 2 and wrong[0][1:] == wrong[1][:0:-1]
    return f"{text}.{' Exchange them.' if exchanged else ''}" if text else ""


def _as_list(given: object) -> list[str]:
    words = given if isinstance(given, list) else [given]
    return [word for word in words if isinstance(word, str)]  # some options have such names, too


def file_kind(path: Path) -> str:
    """Return what a file is, as far as this package knows its kind."""
    if path.suffix.lower() in (".yaml", ".yml"):
        try:
            content = read_mapping(path)
        except ConfigError:
            return ""
        return _STUDY if "controllers" in content else _CONFIGURATION if "loop" in content else ""
    if path.suffix.lower() in _ENDINGS and path.is_file():
        return _ENDINGS[path.suffix.lower()]
    if is_telemetry(path):
        return _TELEMETRY
    try:
        load_gain(path)
    except LbtSynthError:
        return ""
    return _GAIN
