"""Configurations to begin with: one of each telescope, and the examples of the documentation."""

from __future__ import annotations

from importlib import resources

from lbt_synth.validation import choice

_FILES = resources.files(__package__)


def telescope_names() -> list[str]:
    """Return the names of the telescopes that have a template, in alphabetical order."""
    found = (_FILES / "telescopes").iterdir()
    return sorted(file.name.removesuffix(".yaml") for file in found)


def telescope_template(name: str) -> str:
    """Return a commented configuration of a telescope, with published numbers and their sources.

    Parameters
    ----------
    name : str
        ``elt``, ``gemini``, ``generic``, ``keck``, ``lbt`` or ``vlt``. All numbers of ``generic``
        are assumed.

    Returns
    -------
    str
        Text in YAML.

    Raises
    ------
    ProblemError
        If there is no such template.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> print(lbt.config.telescope_template("elt").splitlines()[8])
      diameter_m: 38.5                  # [1]
    """
    choice(name, "name", telescope_names())
    return (_FILES / "telescopes" / f"{name}.yaml").read_text(encoding="utf-8")


def example_files() -> dict[str, str]:
    """Return the texts of the examples of the documentation by the names of their files."""
    found = (_FILES / "examples").iterdir()
    return {file.name: file.read_text(encoding="utf-8") for file in found}
