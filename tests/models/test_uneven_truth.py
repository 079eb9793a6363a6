"""Truths with a spectrum per mode that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from support.uneven_axes import SLOW

import lbt_synth as lbt


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"turbulence": []}, lbt.errors.DimensionError, "got an empty sequence"),
        ({"turbulence": [SLOW, 3.0]}, lbt.errors.ProblemError, "one a mode; got float"),
        ({"turbulence": "slow"}, lbt.errors.ProblemError, "one a mode; got str"),
        (
            {"turbulence": None, "noise_nm": [[1.0]]},
            lbt.errors.DimensionError,
            r"got shape \(1, 1\)",
        ),
        ({"turbulence": None, "noise_nm": []}, lbt.errors.DimensionError, r"got shape \(0,\)"),
        ({"turbulence": None, "noise_nm": [1.0, -1.0]}, lbt.errors.ProblemError, "noise_nm"),
        ({"turbulence": None, "noise_nm": [1.0, np.nan]}, lbt.errors.ProblemError, "noise_nm"),
    ],
)
def test_wrong_truths_are_refused(arguments, error, text):
    with pytest.raises(error, match=text):
        lbt.Truth(**arguments)
