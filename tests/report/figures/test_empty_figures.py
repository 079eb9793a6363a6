"""Figures of nothing."""

from __future__ import annotations

import pytest

import lbt_synth as lbt


def test_empty_figures_are_refused():
    for empty in (
        lambda: lbt.report.figures.sigma_figure({}),
        lambda: lbt.report.figures.loop_figure({}),
        lambda: lbt.report.figures.robustness_figure([]),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="at least one"):
            empty()
