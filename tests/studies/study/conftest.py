"""Fixtures of the tests of Monte Carlo studies."""

import numpy as np
import pytest

NAN = float("nan")


@pytest.fixture
def small_parts(monkeypatch):
    """Parts of seven rows."""
    monkeypatch.setattr("lbt_synth.studies.study.run._ROWS_TOGETHER", 7)


@pytest.fixture
def small():
    """Five samples, two controllers: unstable loops and a failure."""
    return {
        "row": np.array([10, 11, 12, 13, 14]),
        "gain": np.array([0.5, 0.6, 0.7, 0.8, 0.9]),
        "a.stable": np.array([1, 0, 1, NAN, 1]),
        "a.strehl": np.array([0.8, NAN, 0.4, NAN, 0.6]),
        "a.residual_nm": np.array([50, NAN, 90, NAN, 70]),
        "b.stable": np.array([1, 0, 0, 1, 1]),
        "b.strehl": np.array([0.7, NAN, NAN, 0.5, 0.6]),
        "b.residual_nm": np.array([60, NAN, NAN, 80, 70]),
    }
