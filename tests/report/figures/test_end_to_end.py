"""The figure of the paper's tables."""

from __future__ import annotations

from support.end_to_end import make_table

from lbt_synth.report.figures.end_to_end import end_to_end_table_figure


def test_the_figure_has_a_panel_a_controller():
    figure = end_to_end_table_figure(make_table())
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["Kalman", "H∞", "slow"]
    assert figure.axes[0].lines[0].get_label() == "Agapito et al. 2008"
