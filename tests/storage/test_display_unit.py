"""Wavefronts in the unit that people want to see."""

import pytest
from support.refusals import refused

from lbt_synth.storage import display_unit
from lbt_synth.storage.rows import column, fact_table, json_record, nm_column, row_table, table_row


@table_row
class Leaves:
    """What a loop leaves."""

    name: str = column("design", help="Name")
    residual_nm: float = nm_column("residual", help="Residual")
    frequency_hz: float = column("line", unit="Hz", help="Line")


ROW = Leaves(name="a", residual_nm=27.46, frequency_hz=20.0)
SHOWN = {
    "nm": ("mas", pytest.approx(0.1)),
    "nm\u00b2/Hz": ("mas\u00b2/Hz", pytest.approx(0.01)),
    "nm^2": ("mas^2", pytest.approx(0.01)),
    "nmi": ("nmi", 1.0),
    "": ("", 1.0),
}


def test_only_nanometres_change_until_the_command_ends_even_if_it_fails():
    plain = {unit: (unit, 1.0) for unit in SHOWN}
    assert {unit: display_unit.shown_unit(unit) for unit in SHOWN} == plain

    def fail():
        with display_unit.own_display_unit():
            display_unit.show_in("mas", 10.0)
            assert {unit: display_unit.shown_unit(unit) for unit in SHOWN} == SHOWN
            raise ValueError("stop")

    refused(fail, ValueError, "stop")
    assert {unit: display_unit.shown_unit(unit) for unit in SHOWN} == plain
    assert display_unit.nm_text(5.0) == "5 nm"


def test_tables_change_with_their_digits_and_records_do_not():
    given = ((".1f", 0.1), (".1f", 1 / 2055), (".3g", 0.1))
    assert [display_unit.shown_format(*pair) for pair in given] == [".2f", ".4f", ".3g"]
    assert row_table("t", [ROW]).headings[1] == "residual [nm]"
    with display_unit.own_display_unit():
        display_unit.show_in("mas", 10.0)
        assert display_unit.nm_text(27.46, ".1f", unit="nm rms") == "2.75 mas rms"
        assert display_unit.nm_text(27.46, error_nm=1.2) == "2.75 +- 0.12 mas"
        table = row_table("t", [ROW])
        assert table.headings == ("design", "residual [mas]", "line [Hz]")
        assert table.rows == (("a", "2.75", "20"),)
        assert fact_table("t", ROW).rows[1] == ("residual", "2.75", "mas")
        assert json_record(ROW)["residual_nm"] == 27.46
