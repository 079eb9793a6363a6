"""Tables as CSV files, which spreadsheets show and do not run."""

import pytest

from lbt_synth.storage.tables import csv_bytes


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1+2", "-2+3", "@SUM(A1)", "\t=1", "\r=1"])
def test_no_cell_is_a_formula(text):
    (line,) = csv_bytes([text], []).decode().split("\n")[:-1]
    assert line.strip('"').startswith("'" + text[0])


@pytest.mark.parametrize("value", ["-1.5", "+2", "-", "-inf", "a=b", "", -1.5])
def test_numbers_and_dashes_stay(value):
    assert csv_bytes([value], []).decode() == f"{value}\n" if value else '""\n'


def test_halves_of_letters_are_escaped():
    assert csv_bytes(["\udcff"], []) == b"\\udcff\n"
