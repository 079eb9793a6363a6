"""Rows of tables: dataclasses whose fields say how their values are printed.

The same rows make a table for a terminal or a page, a list of facts, a CSV file and JSON.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar, dataclass_transform

import numpy as np

from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.tables import Table, csv_bytes

Row = TypeVar("Row")
NM: Mapping[str, Any] = {"unit": "nm", "format": ".1f"}  # how a residual is printed
PERCENT: Mapping[str, Any] = {"unit": "%", "scale": 100, "format": ".2f"}  # and a Strehl ratio


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """How the values of one field are printed."""

    heading: str = ""  # over the cells of a table; a field without one is in CSV and JSON only
    unit: str = ""  # of the numbers in tables
    format: str = ""  # of numbers, as ".1f"; by default six significant digits
    help: str = ""  # what the value is, without its unit and a full stop
    # from the value, which CSV and JSON hold, to that in tables: 100 for percent
    scale: float = 1.0
    missing: str = "-"  # the cell of nan or None
    key: str = ""  # the name in CSV and JSON; by default that of the field
    name: str = ""  # of the field
    fixed: bool = False  # whether it stays in its unit, as nm of modes that are no tilt

    @property
    def title(self) -> str:
        """The heading with the unit."""
        return f"{self.heading} [{self.shown_unit}]" if self.unit else self.heading

    @property
    def shown_unit(self) -> str:
        """The unit of the numbers in tables, as it is shown."""
        return self.unit if self.fixed else shown_unit(self.unit)[0]

    @property
    def raw_unit(self) -> str:
        """The unit of the value in CSV and JSON."""
        return self.unit if self.scale == 1 else ""

    def text(self, row: Any) -> str:
        """Return the cell of a row."""
        value = getattr(row, self.name)
        factor = 1.0 if self.fixed else shown_unit(self.unit)[1]
        if self.scale * factor != 1 and value is not None:
            value = self.scale * factor * value
        return cell_text(value, shown_format(self.format, factor), missing=self.missing)


def column(
    heading: str = "", *, default: Any = dataclasses.MISSING, init: bool = True, **printing: Any
) -> Any:
    """Return a field of a :func:`table_row`, printed as the attributes of :class:`Column` say."""
    printed = Column(heading=heading, **printing)
    return dataclasses.field(default=default, init=init, metadata={"column": printed})


def nm_column(heading: str, **printing: Any) -> Any:
    """Return a column of nanometres, with one decimal."""
    return column(heading, **{**NM, **printing})


def percent_column(heading: str, **printing: Any) -> Any:
    """Return a column of ratios that tables show in percent, with two decimals."""
    return column(heading, **{**PERCENT, **printing})


@dataclass_transform(
    kw_only_default=True,
    frozen_default=True,
    field_specifiers=(column, nm_column, percent_column, dataclasses.field),
)
def table_row(kind: type[Row]) -> type[Row]:
    r"""Make a frozen dataclass of columns, whose docstring lists them."""
    made = dataclasses.dataclass(frozen=True, slots=True, kw_only=True)(kind)
    lines = [f"{kind.__doc__}\n", "Attributes", "----------"]
    for each in columns(made):
        unit = f" [{each.raw_unit}]" if each.raw_unit else ""
        lines += [f"{each.name} : {kind.__annotations__[each.name]}", f"    {each.help}{unit}."]
    made.__doc__ = "\n".join(lines)
    return made


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Facts:
    """A row whose columns are data; what has no value is None."""

    columns: tuple[Column, ...]
    values: Mapping[str, Any]

    def __getattr__(self, name: str) -> Any:
        """Return the value of a column."""
        if any(column.name == name for column in self.columns):
            return self.values.get(name)
        raise AttributeError(f"there is no column {name!r}")


def fact(value: Any, heading: str = "", **printing: Any) -> tuple[Any, Column]:
    """Return a value, and how it is printed."""
    return value, Column(heading=heading, **printing)


def facts(**named: tuple[Any, Column]) -> Facts:
    """Return a row of what is printed in one place only, each made by :func:`fact`.

    >>> from lbt_synth.storage.rows import fact, facts, json_record
    >>> json_record(facts(rate_hz=fact(800.0, "frame rate", unit="Hz")))
    {'rate_hz': 800.0}
    """
    kept = tuple(dataclasses.replace(how, name=name) for name, (_, how) in named.items())
    return Facts(kept, {name: value for name, (value, _) in named.items()})


def columns(kind: Any) -> tuple[Column, ...]:
    """Return the columns of a row or a row type, in the order of its fields."""
    named = (
        [(each, each.name) for each in kind.columns]
        if isinstance(kind, Facts)
        else [(field.metadata.get("column"), field.name) for field in dataclasses.fields(kind)]
    )
    return tuple(
        dataclasses.replace(given, name=name, key=given.key or name)
        for given, name in named
        if given
    )


def fill_row(kind: type[Row], *sources: Any, **given: Any) -> Row:
    """Return a row of given values, the others attributes of the first source that has them."""
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    names = [each.name for each in fields if each.init]
    for source in sources:
        given = {name: getattr(source, name) for name in names if hasattr(source, name)} | given
    return kind(**given)


def json_record(row: Any, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the values of a row by their keys, but for the fields left out."""
    kept = [each for each in columns(row) if each.name not in without]
    return {each.key: getattr(row, each.name) for each in kept}


def json_units(kind: Any) -> dict[str, str]:
    """Return the units of the values in CSV and JSON, by their keys."""
    return {each.key: each.raw_unit for each in columns(kind) if each.raw_unit}


def csv_rows(rows: Sequence[Any], *, without: Collection[str] = ()) -> bytes:
    """Return rows of one type as a CSV file, with empty cells for nan."""
    records = [json_record(row, without=without) for row in rows]
    cells = [
        ["" if isinstance(v, float) and math.isnan(v) else v for v in record.values()]
        for record in records
    ]
    return csv_bytes(list(records[0]), cells)


def row_table(caption: str, rows: Sequence[Any], *, without: Collection[str] = ()) -> Table:
    """Return a table with one line per row, all of one type; words are flush left."""
    shown = [c for c in columns(rows[0]) if c.heading and c.name not in without]
    return Table(
        caption=caption,
        headings=tuple(each.title for each in shown),
        rows=tuple(tuple(each.text(row) for each in shown) for row in rows),
        words=tuple(
            i for i, each in enumerate(shown) if i and isinstance(getattr(rows[0], each.name), str)
        ),
    )


def fact_table(caption: str, *rows: Any, only: Collection[str] = ()) -> Table:
    """Return a table with one line per value of the rows, leaving out None and empty texts.

    With names of fields only these are in it.
    """
    return Table(
        caption=caption,
        headings=("quantity", "value", "unit"),
        rows=tuple(
            (each.heading, each.text(row), each.shown_unit)
            for row in rows
            for each in columns(row)
            if each.heading
            and (not only or each.name in only)
            and getattr(row, each.name) not in (None, "")
        ),
        words=(2,),
    )


def cell_text(value: Any, spec: str = "", *, missing: str = "-") -> str:
    """Return the text of a cell: six significant digits of a float unless a format is given."""
    if value is None or (isinstance(value, float | np.floating) and math.isnan(value)):
        return missing
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        spec = spec or ".6g"
    if isinstance(value, str) or not spec:
        return str(value)
    text = f"{value:{spec}}"
    return f"{0.0:{spec}}" if float(text) == 0 else text  # never minus zero
