"""What tests read out of figures."""

from __future__ import annotations


def legend(axis):
    """Texts of the legend of a plot."""
    return [text.get_text() for text in axis.get_legend().get_texts()]
