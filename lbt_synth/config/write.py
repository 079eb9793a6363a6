"""Write a configuration file: the values that were set, in schema order, with comments."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ProblemError
from lbt_synth.models import ARModel
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.validation import require_instance

_COLUMN = 40  # where comments begin
_LONGEST_LINE = 10**9  # a list stays on its line


def config_text(settings: FileSection, comments: Mapping[str, str] | None = None) -> str:
    """Return the YAML of a configuration; see :func:`save_config`."""
    require_instance(settings, FileSection)
    content = settings.model_dump(exclude_unset=True)
    left = dict(comments or {})
    head = left.pop("", "")
    for key, comment in left.items():
        if comment.splitlines() not in ([comment], []):
            raise ProblemError(f"the comment on {key} must be one line; got {comment!r}.")
    document = _commented(content, "", left)
    if left:
        raise ProblemError(
            f"comments must be on keys that are written; got one on {next(iter(left))}, which is "
            "not. Keys are paths such as model.vibrations[0].rms_nm."
        )
    text = _dump(document, head)
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


def turbulence_content(model: ARModel) -> dict[str, Any]:
    """Return an auto-regressive model as the section of a configuration."""
    coefficients, driving_rms_nm = model.coefficients.tolist(), model.driving_rms_nm
    return {"kind": "ar", "coefficients": coefficients, "driving_rms_nm": driving_rms_nm}


def _commented(value: Any, path: str, comments: dict[str, str]) -> Any:
    """Return a value with its comments for ruamel; the comments used leave the mapping."""
    if isinstance(value, dict):
        section = CommentedMap()
        for key, inner in value.items():
            own = f"{path}.{key}" if path else key
            section[key] = _commented(inner, own, comments)
            if comment := comments.pop(own, ""):
                section.yaml_add_eol_comment(comment, key, column=_COLUMN)
        return section
    if not isinstance(value, list):
        return value
    entries = CommentedSeq()
    for i, inner in enumerate(value):
        own = f"{path}[{i}]"
        entries.append(_commented(inner, own, comments))
        if comment := comments.pop(own, ""):
            depth = path.count(".") + 1
            entries.yaml_set_comment_before_after_key(i, before=comment, indent=2 * depth)
    if not (value and isinstance(value[0], dict)):
        entries.fa.set_flow_style()
    return entries


def _dump(document: CommentedMap, head: str) -> str:
    """Return the YAML of a document, its sections apart, below the lines of a heading."""
    for key in list(document)[1:]:
        document.yaml_set_comment_before_after_key(key, before="\n")
    if head:
        document.yaml_set_start_comment(head)
    yaml, text = YAML(), io.StringIO()
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = _LONGEST_LINE
    yaml.dump(document, text)
    return text.getvalue()
