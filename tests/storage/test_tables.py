"""Tables as CSV files, which spreadsheets show and do not run."""

from lbt_synth.storage.tables import csv_bytes


def test_no_cell_is_a_formula_and_numbers_stay():
    for text in ("=cmd|' /C calc'!A0", "+1+2", "-2+3", "@SUM(A1)", "\t=1", "\r=1"):
        (line,) = csv_bytes([text], []).decode().split("\n")[:-1]
        assert line.strip('"').startswith("'" + text[0])
    for value in ("-1.5", "+2", "-", "-inf", "a=b", -1.5):
        assert csv_bytes([value], []).decode() == f"{value}\n"
    assert csv_bytes([""], []) == b'""\n'
    assert csv_bytes(["\udcff"], []) == b"\\udcff\n"  # half of a letter
