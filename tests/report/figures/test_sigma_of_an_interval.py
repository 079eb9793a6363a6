"""The figure of singular values of a polytopic design."""

from __future__ import annotations

import pytest
from support.intervals import interval_designs
from support.plants import lbt_axis_plant

import lbt_synth as lbt


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def made():
    return interval_designs()


def test_the_sigma_figure_draws_its_error(made):
    figure = lbt.report.figures.sigma_figure({"interval": made["hinf", 1.0]}, unit_weights=True)
    assert len(figure.axes) == 3
