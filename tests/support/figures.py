"""What tests read out of figures."""

from __future__ import annotations


def legend(axis):
    """Names of what is drawn in a plot, in order, all of which the legend of the figure shows."""
    names = list(dict.fromkeys(axis.get_legend_handles_labels()[1]))
    (shown,) = axis.figure.legends
    assert set(names) <= {text.get_text() for text in shown.get_texts()}
    return names
