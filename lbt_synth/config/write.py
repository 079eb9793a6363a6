"""Write a configuration file: the values that were set, in schema order, with comments."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ProblemError
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.validation import require_instance

_COLUMN = 40  # where comments begin


def config_text(settings: FileSection, comments: Mapping[str, str] | None = None) -> str:
    """Return the YAML of a configuration; see :func:`save_config`."""
    require_instance(settings, FileSection)
    content = settings.model_dump(exclude_unset=True)
    left = dict(comments or {})
    head = left.pop("", "")
    out = [f"# {line}".rstrip() for line in head.splitlines()]
    for key, text in left.items():
        if text.splitlines() not in ([text], []):
            raise ProblemError(f"the comment on {key} must be one line; got {text!r}.")
    for number, (key, value) in enumerate(content.items()):
        if number > 0:
            out.append("")
        out += _write_key(key, value, key, 0, left)
    if left:
        raise ProblemError(
            f"comments must be on keys that are written; got one on {next(iter(left))}, which is "
            "not. Keys are paths such as model.vibrations[0].rms_nm."
        )
    text = "\n".join(out) + "\n"
    try:
        again = FileSection.model_validate(YAML(typ="safe", pure=True).load(text))
    except (YAMLError, ValueError) as error:
        raise ProblemError(
            f"the configuration cannot be written so that it is read again: {error}"
        ) from error
    if again.model_dump(exclude_unset=True) != content:
        raise ProblemError("the configuration would not be read again as it is; it was changed.")
    return text


def save_config(
    path: str | os.PathLike[str],
    settings: FileSection,
    *,
    comments: Mapping[str, str] | None = None,
) -> Path:
    """Write a configuration file that loads with the same values, whole or not at all.

    Only what was set is written; defaults stay out. Numbers keep all their digits. The text is
    read again before it is written.

    Parameters
    ----------
    path : path-like
        The file.
    settings : FileSection
        The settings, for example of :func:`load_config` or :func:`identified_config`.
    comments : mapping of str to str, optional
        Comment at the end of a key's line, by the path of the key, such as
        ``model.vibrations[0].rms_nm``. That of ``""`` heads the file, and may have several lines.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    ProblemError
        If ``settings`` is no FileSection, or a comment has no key or more than one line.
    OutputError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import lbt_synth as lbt
    >>> settings = lbt.load_config("examples/lbt.yaml").settings
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = lbt.config.save_config(
    ...         pathlib.Path(folder) / "again.yaml",
    ...         settings,
    ...         comments={"telescope.diameter_m": "Table I"},
    ...     )
    ...     print(path.read_text().splitlines()[3])
    ...     lbt.load_config(path).settings == settings
      diameter_m: 8.22                      # Table I
    True
    """
    return write_atomically(path, config_text(settings, comments).encode())


def _write_key(
    key: str, value: Any, path: str, depth: int, comments: dict[str, str]
) -> Iterator[str]:
    """Yield the lines of a key; the comments used are removed from the mapping."""
    start = f"{'  ' * depth}{key}:"
    listed = isinstance(value, list) and bool(value) and isinstance(value[0], dict)
    if isinstance(value, dict) and value:
        yield _append_comment(start, comments.pop(path, ""))
        for name, inner in value.items():
            yield from _write_key(name, inner, f"{path}.{name}", depth + 1, comments)
    elif listed:
        yield _append_comment(start, comments.pop(path, ""))
        for index, item in enumerate(value):
            own = f"{path}[{index}]"
            note = comments.pop(own, "")
            if note:
                yield f"{'  ' * (depth + 1)}# {note}"
            rows = [
                row
                for name, inner in item.items()
                for row in _write_key(name, inner, f"{own}.{name}", depth + 2, comments)
            ]
            rows[0] = f"{'  ' * (depth + 1)}- {rows[0].lstrip()}"
            yield from rows
    else:
        yield _append_comment(f"{start} {_inline_value(value)}", comments.pop(path, ""))


def _append_comment(line: str, comment: str) -> str:
    return f"{line:<{_COLUMN - 2}}  # {comment}" if comment else line


def _inline_value(value: Any) -> str:
    """Return a value on one line."""
    if isinstance(value, list):
        return f"[{', '.join(_inline_value(item) for item in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{k}: {_inline_value(v)}' for k, v in value.items())}}}"
    if value is None:
        return "null"
    if isinstance(value, float):
        return repr(value)  # the shortest text that is read as this number
    return str(value)
