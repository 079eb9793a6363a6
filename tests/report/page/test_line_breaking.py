"""Lines of text that fit a width."""

from __future__ import annotations

from lbt_synth.report.page.line_breaking import BODY, MONO, mono_lines, text_width, wrap


def test_lines_fit_their_width():
    words = "some words and an_extremely_long_name_" + 80 * "x" + " and the end"
    lines = wrap(words, BODY, 2.0)
    assert all(text_width(line, BODY) <= 2.0 for line in lines)
    assert "".join(lines).replace(" ", "") == words.replace(" ", "")
    assert all(text_width(line, MONO) <= 3.0 for line in mono_lines(200 * "m", 3.0))
    assert mono_lines("a\n\nb", 3.0) == ["a", "", "b"]
