"""Wavefronts in the unit that people want to see."""

from __future__ import annotations

import pytest

from lbt_synth.storage.display_unit import (
    nm_text,
    own_display_unit,
    show_in,
    shown_format,
    shown_unit,
)
from lbt_synth.storage.rows import column, fact_table, json_record, nm_column, row_table, table_row

MAS = ("mas", 10.0)


@table_row
class Leaves:
    """What a loop leaves."""

    name: str = column("design", help="Name")
    residual_nm: float = nm_column("residual", help="Residual")
    frequency_hz: float = column("line", unit="Hz", help="Line")


ROW = Leaves(name="a", residual_nm=27.46, frequency_hz=20.0)


@pytest.mark.parametrize(
    ("unit", "shown", "factor"),
    [
        ("nm", "mas", 0.1),
        ("nm\u00b2/Hz", "mas\u00b2/Hz", 0.01),
        ("nm^2", "mas^2", 0.01),
        ("nmi", "nmi", 1.0),
        ("", "", 1.0),
    ],
)
def test_only_nanometres_change(unit, shown, factor):
    assert shown_unit(unit) == (unit, 1.0)
    with own_display_unit():
        show_in(*MAS)
        assert shown_unit(unit) == (shown, pytest.approx(factor))
    assert shown_unit(unit) == (unit, 1.0)


def test_the_choice_ends_with_the_command_even_if_it_fails():
    def fail():
        with own_display_unit():
            show_in(*MAS)
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fail()
    assert nm_text(5.0) == "5 nm"


def test_digits_after_the_point_follow_the_size_of_the_unit():
    assert shown_format(".1f", 0.1) == ".2f"
    assert shown_format(".1f", 1 / 2055) == ".4f"
    assert shown_format(".3g", 0.1) == ".3g"
    with own_display_unit():
        show_in(*MAS)
        assert nm_text(27.46, ".1f", unit="nm rms") == "2.75 mas rms"
        assert nm_text(27.46, error_nm=1.2) == "2.75 +- 0.12 mas"


def test_tables_change_and_records_do_not():
    assert row_table("t", [ROW]).headings[1] == "residual [nm]"
    with own_display_unit():
        show_in(*MAS)
        table = row_table("t", [ROW])
        assert table.headings == ("design", "residual [mas]", "line [Hz]")
        assert table.rows == (("a", "2.75", "20"),)
        assert fact_table("t", ROW).rows[1] == ("residual", "2.75", "mas")
        assert json_record(ROW)["residual_nm"] == 27.46
