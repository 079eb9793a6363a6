"""The command paper."""

import re

from support.commands import run


def test_paper(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "a" / "b")
    assert status == 0
    assert "Table III" in text
    assert "fitted" in text
    assert (tmp_path / "a" / "b" / "table_iii.csv").exists()


def test_paper_in_the_unit_of_the_user(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "mas", "--unit", "mas")
    assert status == 0
    assert re.search(r"turbulence pole, rms +0\.98860, 59\.38 mas ", text)
    assert re.search(r"80 mas as the rms of a sinusoid +80\.00 mas ", text)
    assert " nm" not in text
    assert "797.0 nm" in (tmp_path / "mas" / "parameters.csv").read_text()  # CSV stays in nm
