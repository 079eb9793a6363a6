"""A table on a screen: one part, with the rows and columns that the verdict names."""

import pytest

from lbt_synth.report.screen import brief_table
from lbt_synth.storage.tables import Table, text_lines


@pytest.mark.parametrize("count", [2, 7, 12])
def test_long_names_are_shortened_before_columns_are_left_out(count):
    """Seven nights fit with short names, twelve with the columns that the verdict names."""
    nights = [f"night_of_november_{i}.fits" for i in range(1, count + 1)]
    headings = ("design of", *(f"{night} [nm]" for night in nights), "at worst")
    rows = tuple((name, *["37.2"] * count, "1.000") for name in (*nights, "all nights"))
    verdict = f"That of {nights[-1]} is written; at worst it leaves 37.2 nm."
    brief = brief_table(Table(caption="", headings=headings, rows=rows), 100, 12, verdict)
    lines, names = text_lines(brief, 100), [row[0].text for row in brief.cells()]
    assert (max(map(len, lines)) <= 100, sum(line.startswith(" ─") for line in lines)) == (True, 1)
    assert (len({*names}), len({*brief.headings})) == (len(brief.rows), len(brief.headings))
    assert brief.headings[-2:] == (f"{names[-2]} [nm]", "at worst")
    assert ("…" in names[-2], "of 13 columns" in brief.caption) == (count > 2, count == 12)


def test_rows_of_a_verdict_are_shown():
    rows = tuple((f"r{i}", str(i)) for i in range(40))
    table = Table(caption="", headings=("row", "value"), rows=rows)
    shown = [name for name, _ in brief_table(table, 80, 4, "Worst is r17, not r3-b or r5.x.").rows]
    assert shown == ["r0", "r17", "r20", "r39"]
