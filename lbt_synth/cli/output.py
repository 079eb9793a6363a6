"""What a command prints and writes: the point first, one table, JSON, rows and figures."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import sys
from argparse import Namespace
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import input_files
from lbt_synth.cli.streams import printable
from lbt_synth.report.draw import FIGURE_ENDINGS, save_figure
from lbt_synth.report.screen import brief_table
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically
from lbt_synth.storage.rows import (
    cell_text,
    csv_rows,
    fact_table,
    json_record,
    json_units,
    row_table,
)
from lbt_synth.storage.tables import Table, text_lines

_WIDTH = 200  # columns of --verbose where the output is no terminal
_BRIEF_WIDTH, _BRIEF_LINES, BRIEF_ROWS = 100, 25, 12  # without --verbose: a screen
BRIEF_SENTENCES = 3  # of the verdict on it
_NEXT_SENTENCE = re.compile(r"(?<=\.) (?=\S)")
_WRITTEN = "written: "
# what of the notes is printed without --verbose, in this order: the first two whole, if they fit
# into some lines, else two lines of each
_URGENT = ("assumes", "warning", "note")
_URGENT_LINES = 8
_WORDS = ("unit", "method", "computed by", "origin")  # columns of words are flush left


@dataclass(kw_only=True)
class Report:
    """What a command reports, for programs and for people."""

    data: dict[str, Any] = field(default_factory=dict)  # for ``--json``; nan and inf become null
    verdict: list[str] = field(default_factory=list)  # sentences, what matters most first
    tables: list[Table] = field(default_factory=list)  # the first is printed without --verbose
    notes: list[str] = field(default_factory=list)  # lines below the tables
    passed: bool = True  # False makes the exit status 1
    # what -o writes: rows of a .csv, but for some of their fields, and a figure
    rows: Sequence[Any] = ()
    without: Collection[str] = ()
    figure: Callable[[], Any] | None = None

    def add_table(
        self, caption: str, headings: Sequence[str], cells: Iterable[Sequence[Any]]
    ) -> None:
        """Add a table of values of any kind, for people only."""
        rows = tuple(tuple(map(cell_text, row)) for row in cells)
        words = tuple(i for i, heading in enumerate(headings) if i and heading in _WORDS)
        self.tables.append(Table(caption=caption, headings=tuple(headings), rows=rows, words=words))

    def add_rows(
        self,
        key: str,
        caption: str,
        rows: Sequence[Any],
        *,
        without: Collection[str] = (),
        hidden: Collection[str] = (),
        figure: Callable[[], Any] | None = None,
    ) -> None:
        """Add rows of one type under a key of the data, with their units, and as a table.

        Fields of ``without`` are left out of both, and those of ``hidden`` out of the table. With a
        figure, it and the rows are what -o writes.
        """
        if figure is not None:
            self.rows, self.without, self.figure = rows, without, figure
        self.data[key] = [json_record(row, without=without) for row in rows]
        self._add_units(rows[0])
        self.tables.append(row_table(caption, rows, without=(*without, *hidden)))

    def add_records(self, *rows: Any, key: str = "") -> None:
        """Add the values of rows, with their units, to the data or under a key of it."""
        data = self.data.setdefault(key, {}) if key else self.data
        for row in rows:
            data |= json_record(row)
            self._add_units(row)

    def add_facts(self, caption: str, *facts: Any, key: str = "") -> None:
        """Add the values of rows to the data, or under a key of it, and as a table, one a line."""
        self.add_records(*facts, key=key)
        self.tables.append(fact_table(caption, *facts))

    def _add_units(self, row: Any) -> None:
        if units := self.data.get("units", {}) | json_units(row):
            self.data["units"] = units

    def note_written(self, *paths: str | os.PathLike[str]) -> None:
        """Add files that were written to the data, and a line about each to the notes."""
        self.data["files"] = [*self.data.get("files", ()), *map(str, paths)]
        self.notes += [f"{_WRITTEN}{path}" for path in paths]

    def print(self, *, as_json: bool = False, verbose: bool = False) -> None:
        """Print to standard output."""
        if as_json:
            said = {"verdict": self.verdict} if self.verdict else {}
            print(json.dumps(json_value(said | self.data), allow_nan=False))
            return
        room = shutil.get_terminal_size().columns if sys.stdout.isatty() else _WIDTH
        lacks_line = "─".encode(sys.stdout.encoding or "utf-8", "replace") == b"?"
        rule = "-" if lacks_line else "─"
        for line in self._all(room, rule) if verbose else self._brief(room, rule):
            print(printable(line.replace("…", "~") if lacks_line else line))

    def _all(self, room: int, rule: str) -> Iterator[str]:
        """Yield all that there is to say."""
        for sentence in self.verdict:
            yield from _wrapped(sentence, room)
        for table in self.tables:
            yield from text_lines(table, room, rule=rule)
        yield from self.notes

    def _brief(self, room: int, rule: str) -> list[str]:
        """Return the verdict, the first table and what is urgent, at most a screen."""
        room = min(room, _BRIEF_WIDTH)
        files = [note.removeprefix(_WRITTEN) for note in self.notes if note.startswith(_WRITTEN)]
        written = [f"{_WRITTEN}{', '.join(files)}"] if files else []
        if files and len(written[0]) > room and len(files) > 1:
            written = [f"{_WRITTEN}{len(files)} files, {files[0]} to {files[-1]}"]
        sentences = _NEXT_SENTENCE.split(" ".join(self.verdict))
        verdict = _wrapped(" ".join(sentences[:BRIEF_SENTENCES]), room)
        *urgent, notes = ([n for n in self.notes if n.startswith(mark)] for mark in _URGENT)
        kept = [line for marks in urgent for note in marks for line in _wrapped(note, room)]
        if len(kept) > _URGENT_LINES:  # the ends of sentences are left out, no sentence
            cut: dict[str, Any] = {"max_lines": 2, "placeholder": " ... (--verbose)"}
            kept = [x for marks in urgent for note in marks for x in _wrapped(note, room, **cut)]
        space = _BRIEF_LINES - len(written)
        most = max(space - 1 - len([*verdict, *kept]), 0)
        table: list[str] = []
        for count in range(BRIEF_ROWS, 1, -1) if self.tables else ():
            brief = brief_table(self.tables[0], room, count, " ".join(verdict))
            table = [""] * bool(verdict) + text_lines(brief, room, rule=rule)
            if len(table) <= most:
                break
        lines, more = verdict + table[:most] + kept, [_wrapped(note, room) for note in notes]
        hidden = len(lines) + sum(map(len, more)) > space or len(table) > most
        hidden |= len(sentences) > BRIEF_SENTENCES
        while more and len(lines) + len(more[0]) <= space - hidden:  # no sentence is cut
            lines += more.pop(0)
        if hidden:
            lines = [*lines[: space - 1], "... more with --verbose"]
        return lines + written


def _wrapped(text: str, room: int, **cut: Any) -> list[str]:
    """Return a text in lines, with no name of a file broken, and no % apart from its number."""
    joined = text.replace(" %", "\u00a0%")
    lines = wrap(joined, room, break_long_words=False, break_on_hyphens=False, **cut)
    return [line.replace("\u00a0", " ") for line in lines]


def json_value(value: Any) -> Any:
    """Convert a value to the types that JSON has."""
    if isinstance(value, dict):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(v) for v in value]
    if isinstance(value, np.ndarray):
        return json_value(value.tolist())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value


def run_with_outputs(run: Callable[[Namespace], Report], arguments: Namespace) -> Report:
    """Run a command, and write its rows to outputs in .csv and its figure to all others.

    An output that cannot become one or the other, or would replace an input, is refused before.
    """
    outputs = getattr(arguments, "output", None)
    if not isinstance(outputs, list):  # of a command that writes something else
        return run(arguments)
    for output in outputs:
        require_ending(output, "an output", (".csv", *FIGURE_ENDINGS))
    require_writable(*outputs, inputs=input_files(arguments))
    report = run(arguments)
    if (figure := report.figure) is not None:
        report.note_written(
            *(
                write_atomically(output, csv_rows(report.rows, without=report.without))
                if output.lower().endswith(".csv")
                else save_figure(figure(), output)
                for output in outputs
            )
        )
    return report
