"""What a page is made of: paragraphs, notices, tables, listings and charts, in sections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.pages.charts import Chart, require_key
from lbt_synth.validation import choice

TONES = ("plain", "good", "bad", "note")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell of a table that is not only a text.

    Attributes
    ----------
    text : str
        The text.
    tone : str
        "plain", "good", "bad" or "note"; the text has to say it, too.
    """

    text: str
    tone: str = "plain"

    def __post_init__(self) -> None:
        choice(self.tone, "tone", TONES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table; the first cell of each row is its heading.

    Attributes
    ----------
    caption : str
        What it holds.
    headings : tuple of str
        One a column, the first over the headings of the rows.
    rows : tuple of tuple of str or Cell
        One a row; a row of a single cell is a heading of the rows below.
    words : tuple of int
        Columns of words, which are set flush left; the first one always is.
    """

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    words: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "headings", tuple(self.headings))
        object.__setattr__(self, "rows", tuple(tuple(row) for row in self.rows))
        for row in self.rows:
            if len(row) not in (1, len(self.headings)):
                raise DimensionError(
                    f"a row of {self.caption!r} must have 1 or {len(self.headings)} cells; got "
                    f"{len(row)}."
                )

    def cells(self) -> Iterator[tuple[Cell, ...]]:
        """Rows with every text as a cell."""
        for row in self.rows:
            yield tuple(Cell(text=c) if isinstance(c, str) else c for c in row)

    def by_columns(self, most: int) -> Iterator[Table]:
        """Tables of so many columns at most after the first, which all of them repeat."""
        columns = range(1, len(self.headings))
        for start in range(1, max(len(self.headings), 2), most):
            kept = [c for c in columns if start <= c < start + most]
            yield Table(
                caption=self.caption if start == 1 else f"{self.caption} (continued)",
                headings=(self.headings[0], *(self.headings[c] for c in kept)),
                rows=tuple(
                    row if len(row) == 1 else (row[0], *(row[c] for c in kept)) for row in self.rows
                ),
                words=tuple(i + 1 for i, c in enumerate(kept) if c in self.words),
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Paragraph:
    """A paragraph of plain text."""

    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A paragraph that must not be overlooked.

    Attributes
    ----------
    text : str
        The text.
    tone : str
        "bad" for what is wrong, "note" for what has to be known, "good" for what was proved.
    """

    text: str
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
    """A section of a page.

    Attributes
    ----------
    key : str
        Its anchor: small letters, digits and hyphens; unique in the page.
    title : str
        Its heading.
    blocks : tuple of Paragraph, Notice, Listing, Table or Chart
        What is in it.
    """

    key: str
    title: str
    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", tuple(self.blocks))
        require_key(self.key)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Page:
    """A whole page, for the screen or for paper.

    Attributes
    ----------
    title : str
        Its heading.
    subtitle : str
        A line below, such as what it is about and when it was made.
    sections : tuple of Section
        Its sections; the first one stands on the title page.
    creator : str
        Program and version that made it.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    creator: str

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
