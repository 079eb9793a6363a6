"""What a page is made of: paragraphs, notices, tables, listings and charts, in sections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from lbt_synth.errors import ProblemError
from lbt_synth.report.charts.description import Chart, require_key
from lbt_synth.storage.tables import TONES, Table
from lbt_synth.validation import choice


@dataclass(frozen=True, slots=True, kw_only=True)
class Paragraph:
    """A paragraph of plain text."""

    text: str


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


Block: TypeAlias = Paragraph | Notice | Listing | Table | Chart


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """A section of a page."""

    key: str  # Its anchor: small letters, digits and hyphens; unique in the page
    title: str  # Its heading
    blocks: tuple[Block, ...]  # What is in it

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", tuple(self.blocks))
        require_key(self.key)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Page:
    """A whole page, for the screen or for paper."""

    title: str  # Its heading
    subtitle: str  # A line below, such as what it is about and when it was made
    sections: tuple[Section, ...]  # Its sections; the first one stands on the title page

    def __post_init__(self) -> None:
        object.__setattr__(self, "sections", tuple(self.sections))
        keys = [section.key for section in self.sections] + [c.key for c in self.charts]
        repeated = sorted({key for key in keys if keys.count(key) > 1})
        if repeated:
            raise ProblemError(f"keys of a page must be unique; got {', '.join(repeated)} twice.")

    @property
    def charts(self) -> Sequence[Chart]:
        """All charts, in their order."""
        return [b for section in self.sections for b in section.blocks if isinstance(b, Chart)]
