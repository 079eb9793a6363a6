"""Tables of statistics."""

import numpy as np
from support.study_results import cell_text, make_columns

import lbt_synth as lbt
from lbt_synth.storage.display_unit import own_display_unit, show_in
from lbt_synth.studies.study.summary import (
    comparison_table,
    sensitivity_table,
    worst_table,
)

NAN = float("nan")


def test_a_controller_that_always_failed_has_dashes_and_no_numbers():
    columns = make_columns({"p": np.linspace(0, 1, 50)}, {"a": np.linspace(0, 1, 50)})
    columns |= {"b.stable": np.full(50, NAN), "b.strehl": np.full(50, NAN)}
    columns["b.residual_nm"] = np.full(50, NAN)
    found = lbt.studies.study_statistics(columns, ["p"], ["a", "b"])
    assert found.controllers[1].samples == 0
    assert found.controllers[1].failed == 50
    assert found.controllers[1].worst == ()
    first = lbt.studies.summary_tables(found)[0]
    column = {row[0]: cell_text(row[2]) for row in first.rows if len(row) > 1}
    assert (column.pop("evaluated"), column.pop("failed")) == ("0", "50")
    assert set(column.values()) == {"-"}


def test_tables(small):
    found = lbt.studies.study_statistics(small, ["gain"], ["a", "b"])
    tables = {table.caption.split(" over")[0]: table for table in lbt.studies.summary_tables(found)}
    assert len(tables) == 3  # too few samples for indices
    strehl = {
        cell_text(row[0]): cell_text(row[1]) for row in tables["Strehl ratio"].rows if len(row) > 1
    }
    assert strehl["mean ± standard error"] == "45.00 ± 17.08"
    assert strehl["50th percentile"] == "50.0"
    assert strehl["above 50 %"].startswith("50.0 (6.8 to 93.2")
    assert strehl["unstable, counted as 0"].startswith("25.00 (0.63 to 80.59")
    assert (strehl["evaluated"], strehl["failed"]) == ("4", "1")
    residual = {row[0]: row[1] for row in tables["Residual of tip and tilt"].rows if len(row) > 1}
    assert residual["99th percentile"] == "unstable"
    assert residual["of noise"] == "20.0"
    with own_display_unit():
        show_in("mas", 8.0)
        angles = lbt.studies.summary_tables(found)[1]
    assert angles.headings[0] == "residual [mas rms]"
    assert {row[0]: row[1] for row in angles.rows if len(row) > 1}["of noise"] == "2.50"
    worst = worst_table(found.controllers[0], small, ["gain"])
    assert [cell_text(cell) for cell in worst.rows[0]] == ["11", "unstable", "0.6"]
    assert [cell_text(cell) for cell in worst.rows[1]] == ["12", "40.0", "0.7"]


def test_a_table_compares_every_pair(small):
    small |= {name.replace("b.", "c."): small[name] for name in list(small) if name[:2] == "b."}
    found = lbt.studies.study_statistics(small, ["gain"], ["a", "b", "c"])
    rows = comparison_table(found).rows
    assert [row[0] for row in rows] == ["a less b", "a less c", "b less c"]
    assert rows[0][1:4] == ("50.0", "50.0", "12.50 ± 9.46")
    assert rows[2][1:4] == ("0.0", "100.0", "0.00 ± 0.00")
    assert rows[2][4:] == ("+0.0", "+0.0", "+0.0")


def test_tables_of_one_controller_have_no_comparison():
    columns = make_columns({"p": np.linspace(0, 1, 50)}, {"a": np.linspace(0, 1, 50)})
    found = lbt.studies.study_statistics(columns, ["p"], ["a"])
    captions = [table.caption for table in lbt.studies.summary_tables(found)]
    assert not any("same samples" in caption for caption in captions)
    index = next(t for t in lbt.studies.summary_tables(found) if t.caption.startswith("Variance"))
    assert [row[0] for row in index.rows] == [
        "p",
        "all of them",
        "sum",
        "only together (interactions)",
    ]
    assert index.rows[0][1] == "100.0 ± 0.0 (+1.00)"
    named = sensitivity_table(found, names={"p": "short"})
    assert named.rows[0][0] == "short"
