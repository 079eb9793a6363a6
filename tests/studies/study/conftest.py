"""Fixtures of the tests of Monte Carlo studies."""

import pytest


@pytest.fixture
def small_batches(monkeypatch):
    """As if every row took long: batches are shares of what is left."""
    monkeypatch.setattr("lbt_synth.studies.study.batch_queue._CRUMB_SECONDS", 0.0)
