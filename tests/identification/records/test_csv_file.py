"""Tables of text: delimiters, headings, gaps."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lbt_synth.identification.records.csv_file import read_csv


@settings(max_examples=40)
@given(
    rows=st.lists(
        st.tuples(*[st.one_of(st.none(), st.floats(allow_nan=False, allow_infinity=False))] * 3),
        min_size=1,
        max_size=8,
    ),
    sign=st.sampled_from([",", ";", "\t", "|"]),
    heading=st.booleans(),
)
def test_any_table_comes_back(rows, sign, heading):
    head = [sign.join(["alpha", "beta", "gamma"])] if heading else []
    lines = [sign.join("" if v is None else repr(v) for v in row) for row in rows]
    table = read_csv("\n".join(head + lines))
    expected = np.array([[np.nan if v is None else v for v in row] for row in rows])
    assert np.array_equal(table.values, expected, equal_nan=True)
    assert table.names == (["alpha", "beta", "gamma"] if heading else [""] * 3)


def test_headings_in_comments_and_decimal_commas():
    table = read_csv("# time_s y_nm\n0.0 1.5\n0.1 2.5\n")
    assert table.names == ["time_s", "y_nm"]
    table = read_csv("t_s;y_nm\n0,5;1,25\n1,0;-2\n")
    assert table.values.tolist() == [[0.5, 1.25], [1.0, -2.0]]
    assert table.notes == ["commas were taken for decimal points"]
