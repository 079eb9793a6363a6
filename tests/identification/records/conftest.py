"""Series that the tests of files share."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def series():
    """Measurements and commands, (60, 2) each."""
    rng = np.random.default_rng(0)
    return 20 * rng.standard_normal((60, 2)), 20 * rng.standard_normal((60, 2))
