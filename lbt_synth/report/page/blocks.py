"""What a page is made of: sections of paragraphs, notices, tables, listings and charts.

The words of charts and paragraphs are data, in ``words.toml``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import TypeAlias

from lbt_synth.errors import ProblemError
from lbt_synth.report.draw import Figure
from lbt_synth.report.provenance import SourceFile, program_versions
from lbt_synth.storage.rows import row_table
from lbt_synth.storage.tables import TONES, Table
from lbt_synth.validation import choice

_KEY = re.compile(r"[a-z][a-z0-9-]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A paragraph that must not be overlooked."""

    text: str
    # "bad" for what is wrong, "note" for what has to be known, "good" for what was proved
    tone: str = "note"

    def __post_init__(self) -> None:
        choice(self.tone, "tone", TONES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Listing:
    """A text as it is in a file, line by line."""

    caption: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """A figure with its words; the page has its numbers, too."""

    key: str  # Its anchor in the page: small letters, digits and hyphens; unique in the page
    title: str  # A short heading
    caption: str  # What is seen and how to read it
    alt: str  # The same for those who do not see it: what is drawn, and what it shows
    figure: Figure

    def __post_init__(self) -> None:
        _require_key(self.key)
        for name in ("title", "caption", "alt"):
            if not getattr(self, name).strip():
                raise ProblemError(f"a chart must have words for its {name}; got none.")


Block: TypeAlias = str | Notice | Listing | Table | Chart  # a text is a paragraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """A section of a page."""

    key: str  # Its anchor: small letters, digits and hyphens; unique in the page
    title: str  # Its heading
    blocks: Sequence[Block]  # What is in it

    def __post_init__(self) -> None:
        _require_key(self.key)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Page:
    """A whole page, for the screen or for paper; a section without blocks is left out."""

    title: str  # Its heading
    subtitle: str  # A line below, such as what it is about and when it was made
    sections: tuple[Section, ...]

    def __post_init__(self) -> None:
        kept = tuple(section for section in self.sections if section.blocks)
        object.__setattr__(self, "sections", kept)
        keys = [section.key for section in self.sections] + [c.key for c in self.charts]
        repeated = sorted({key for key in keys if keys.count(key) > 1})
        if repeated:
            raise ProblemError(f"keys of a page must be unique; got {', '.join(repeated)} twice.")

    @property
    def charts(self) -> list[Chart]:
        """All charts, in their order."""
        return [b for section in self.sections for b in section.blocks if isinstance(b, Chart)]


def _require_key(key: str) -> None:
    """Refuse what cannot be an anchor."""
    if not _KEY.fullmatch(key):
        raise ProblemError(
            f"a key must be of small letters, digits and hyphens, and start with a letter; "
            f"got {key!r}."
        )


@cache
def words() -> dict[str, dict[str, str]]:
    """Return the texts of ``words.toml`` by group and name, each on one line."""
    path = files("lbt_synth.report.page") / "words.toml"
    texts: dict[str, dict[str, str]] = tomllib.loads(path.read_text(encoding="utf-8"))
    return {
        group: {name: " ".join(text.split()) for name, text in own.items()}
        for group, own in texts.items()
    }


def chart(key: str, figure: Figure, *, group: str = "", **facts: object) -> Chart:
    """Return a chart with the words of its key, or of another group, and facts filled in.

    A key that ends in a number is that of a continuation, with the words of the first one.
    """
    name, _, number = key.rpartition("-")
    own = words().get(group or key) or words()[name]
    texts = {name: text.format(**facts) for name, text in own.items()}
    if not group and number.isdigit():
        texts["title"] += " (continued)"
    return Chart(key=key, figure=figure, **texts)


def paragraph(name: str, /, **facts: object) -> str:
    """Return the text of a paragraph with facts filled in."""
    return words()["paragraphs"][name].format(**facts)


def source_section(
    sources: Sequence[SourceFile] = (),
    *,
    versions: Sequence[tuple[str, str]] | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
    about: Table | None = None,
) -> Section:
    """Return the last section of a page: what it was made from, and by which programs.

    Texts are listed under their captions.
    """
    made_with = tuple(program_versions() if versions is None else versions)
    return Section(
        key="sources",
        title="Files and versions",
        blocks=(
            *([] if about is None else [about]),
            *([row_table("Files that were read", sources)] if sources else []),
            Table(caption="Made with", headings=("program", "version"), rows=made_with, words=(1,)),
            *(Listing(caption=caption, text=text) for caption, text in texts.items()),
        ),
    )
