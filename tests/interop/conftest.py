"""Designs for the LBT that the tests of all exports share."""

from __future__ import annotations

import pytest
from support.exports import lbt_config, lbt_designs


@pytest.fixture
def loaded():
    return lbt_config()


@pytest.fixture
def designs():
    return lbt_designs()
