"""The command paper."""

from __future__ import annotations

from support.commands import run


def test_paper(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "a" / "b")
    assert status == 0
    assert "Table III" in text
    assert "fitted" in text
    assert (tmp_path / "a" / "b" / "table_iii.csv").exists()
