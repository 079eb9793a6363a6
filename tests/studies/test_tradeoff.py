"""The trade-off between variance and norm."""

import numpy as np
import pytest
from support.figures import legend
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.report.figures.studies import tradeoff_figure


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


def test_the_front_of_the_lbt(plant):
    """A norm close to its least costs sensor-gain robustness, whichever filter has it."""
    points = list(lbt.studies.tradeoff(plant, points=5, taps=8))
    for family in ("mixed", "central"):
        own = [point for point in points if point.family == family]
        gamma, rms, low = ([getattr(p, key) for p in own] for key in ("gamma", "rms", "gain_low"))
        assert gamma == sorted(gamma)
        assert rms == sorted(rms, reverse=True)
        assert low == sorted(low, reverse=True)
        assert low[0] > 0.7 > 0.1 > low[-1]
    for mixed, central in zip(points[2:-2:2], points[3:-2:2], strict=True):
        assert mixed.rms < central.rms
        assert mixed.gain_low < central.gain_low  # it tolerates more, too
    figure = tradeoff_figure(points)
    assert len(figure.axes) == 2
    assert legend(figure.axes[0])[0] == "least variance at this norm"
    assert figure.axes[1].get_xlabel() == "H∞ norm of the estimation error [nm]"


def test_a_front_without_a_loop():
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    points = list(lbt.studies.tradeoff(walk, points=2, families=["central"]))
    assert np.isnan(points[0].gain_low)
    assert len(tradeoff_figure(points).axes) == 1
    with pytest.raises(lbt.errors.ProblemError, match="families must be"):
        next(lbt.studies.tradeoff(walk, families=["best"]))
    with pytest.raises(lbt.errors.ProblemError, match="points must be at least 2"):
        next(lbt.studies.tradeoff(walk, points=1))
    with pytest.raises(lbt.errors.ProblemError, match="at least one point"):
        tradeoff_figure([])
