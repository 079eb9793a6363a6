"""Rows print themselves as tables, facts, CSV and JSON."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from lbt_synth.storage import rows


@rows.table_row
class Loop:
    """One loop."""

    name: str = rows.column("loop", key="row", help="Name of the loop")
    method: str = rows.column("method", help="How it was designed")
    error_hz: float = rows.column("error", unit="Hz", format="+.2f", help="Model less truth")
    strehl: float = rows.column("Strehl", unit="%", scale=100, format=".1f", help="Strehl ratio")
    residual_nm: float = rows.column("residual", unit="nm", format=".1f", missing="unstable")
    gamma: float = rows.column(unit="nm", help="Norm")
    limit_nm: float | None = rows.column("limit", unit="nm", default=None)
    stable: bool = rows.column("stable", default=True)
    design: object = dataclasses.field(default=None, compare=False)


GOOD = Loop(name="a", method="kalman", error_hz=-0.001, strehl=0.8, residual_nm=12.34, gamma=1 / 3)
LOST = {"strehl": math.nan, "residual_nm": math.nan, "stable": False}
WILD = Loop(name="b", method="hinf", error_hz=1, gamma=2.0, limit_nm=9.0, **LOST)
ROWS = [GOOD, WILD]


def test_a_table_has_headings_with_units_and_formatted_cells():
    table = rows.row_table("Loops", ROWS)
    headings = "loop, method, error [Hz], Strehl [%], residual [nm], limit [nm], stable"
    assert ", ".join(table.headings) == headings
    assert table.rows == (
        ("a", "kalman", "+0.00", "80.0", "12.3", "-", "yes"),
        ("b", "hinf", "+1.00", "-", "unstable", "9", "no"),
    )
    assert table.words == (1,)
    values = math.nan, np.float64(-0.0), math.inf, 1234567.0, np.bool_(True), 12345678
    assert [*map(rows.cell_text, values)] == ["-", "0", "inf", "1.23457e+06", "yes", "12345678"]
    assert (
        rows.row_table("Loops", ROWS, without=["limit_nm", "stable"]).headings[-1]
        == "residual [nm]"
    )


def test_csv_and_json_hold_the_values_themselves():
    first, second = rows.csv_rows(ROWS, without=["stable"]).decode().splitlines()[1:]
    assert first == "a,kalman,-0.001,0.8,12.34,0.3333333333333333,"
    assert second == "b,hinf,1,,,2.0,9.0"
    record = rows.json_record(GOOD)
    assert " ".join(record) == "row method error_hz strehl residual_nm gamma limit_nm stable"
    assert record["gamma"] == 1 / 3
    assert "limit_nm" not in rows.json_record(GOOD, without=["limit_nm"])
    # a scaled value has the unit of tables in tables only
    in_nm = dict.fromkeys(("residual_nm", "gamma", "limit_nm"), "nm")
    assert rows.json_units(Loop) == {"error_hz": "Hz"} | in_nm


def test_facts_leave_out_what_does_not_apply():
    table = rows.fact_table("Loop", GOOD, WILD)
    assert table.headings == ("quantity", "value", "unit")
    assert table.rows[2:4] == (("error", "+0.00", "Hz"), ("Strehl", "80.0", "%"))
    assert [row[0] for row in table.rows].count("limit") == 1
    assert table.rows[-2:] == (("limit", "9", "nm"), ("stable", "no", ""))


def test_rows_are_documented_frozen_and_compared_by_value():
    assert Loop.__doc__.startswith("One loop.\n\nAttributes\n----------\nname : str\n    Name of")
    assert "error_hz : float\n    Model less truth [Hz].\n" in Loop.__doc__
    assert "strehl : float\n    Strehl ratio.\n" in Loop.__doc__
    assert "design" not in [each.name for each in rows.columns(Loop)]
    assert dataclasses.replace(GOOD, design="another") == GOOD
    with pytest.raises(dataclasses.FrozenInstanceError):
        GOOD.gamma = 1.0
    with pytest.raises(TypeError, match="missing 5 required keyword-only arguments"):
        Loop(name="a")


def test_a_row_takes_what_is_not_given_from_its_sources():
    class Margins:
        gamma = 3.0
        strehl = 0.5

    row = rows.fill_row(Loop, Margins(), GOOD, name="c", stable=False)
    expected = {"name": "c", "method": "kalman", "error_hz": -0.001, "strehl": 0.5, "gamma": 3.0}
    assert expected.items() | {("stable", False)} <= dataclasses.asdict(row).items()
    with pytest.raises(TypeError, match="missing"):
        rows.fill_row(Loop, Margins(), name="c")
