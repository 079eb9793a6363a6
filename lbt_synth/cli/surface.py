"""Errors in the words of the terminal: options and keys for arguments, and what a file is.

Messages name the arguments of functions in three forms: ``name=value``, a name before "must" or
after "give", and names of several words. The options of the command and the keys of its
configuration that have such a name are said instead.
"""

from __future__ import annotations

import re
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import BaseModel

from lbt_synth.cli.parser import command_options
from lbt_synth.config.load import read_mapping
from lbt_synth.config.schema import FileSection
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
    """Name options and keys where a message names arguments of functions."""
    options = command_options(arguments.command)
    given = {name for name, (_, usual) in options.items() if getattr(arguments, name) != usual}
    keys = _unique_keys() if "config" in arguments else {}

    def name(found: re.Match[str]) -> str:
        word = found[0]
        if word in options and (word in given or word not in keys):
            return options[word][0]
        return keys.get(word, word)

    def setting(found: re.Match[str]) -> str:
        word, value = found.groups()
        if word in options:
            pairs = re.findall(r"'(\w+)': ([^,}]+)", value)
            words = [f"{key}={entry}" for key, entry in pairs] or [value.strip("'\"")]
            return " ".join([options[word][0], *words])
        return f"{keys[word]}: {value}" if word in keys else found[0]

    return _NAME.sub(name, _SETTING.sub(setting, message))


def _unique_keys() -> Mapping[str, str]:
    """Return the paths of keys outside lists by their last names, where only one has it."""
    paths = list(_key_paths(FileSection))
    counts = Counter(path.rpartition(".")[2] for path in paths)
    last = {path: path.rpartition(".")[2] for path in paths}
    return {name: path for path, name in last.items() if counts[name] == 1}


def _key_paths(section: type[BaseModel], place: str = "") -> Iterator[str]:
    for name, field in section.model_fields.items():
        yield f"{place}{name}"
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from _key_paths(kind, f"{place}{name}.")


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
