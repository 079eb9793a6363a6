"""The words of charts and paragraphs, read from ``words.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files

from lbt_synth.report.charts.description import Chart, Panel


@cache
def _all_words() -> dict[str, dict[str, str]]:
    """Return the texts of ``words.toml`` by group and name, each on one line."""
    path = files("lbt_synth.report.page") / "words.toml"
    texts: dict[str, dict[str, str]] = tomllib.loads(path.read_text(encoding="utf-8"))
    return {
        group: {name: " ".join(text.split()) for name, text in own.items()}
        for group, own in texts.items()
    }


def chart(
    key: str, panels: Sequence[Panel], *, words: str = "", columns: int = 1, **facts: object
) -> Chart:
    """Return a chart with the words of its key, or of the key ``words``, and facts filled in."""
    own = {name: text.format(**facts) for name, text in _all_words()[words or key].items()}
    return Chart(key=key, panels=tuple(panels), columns=columns, **own)


def paragraph(name: str, /, **facts: object) -> str:
    """Return the text of a paragraph with facts filled in."""
    return _all_words()["paragraphs"][name].format(**facts)
