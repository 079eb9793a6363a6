"""Labels of lines in the figure of an identified spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.report.figures.identification import _spread_labels


@given(st.lists(st.floats(0, 1), max_size=40))
def test_labels_do_not_overlap(wanted):
    wanted = sorted(wanted)
    places = _spread_labels(wanted)
    gap = min(0.045, 1 / max(len(wanted), 1))
    assert places.size == len(wanted)
    assert np.all(np.diff(places) > gap - 1e-9)
    assert np.all((places > 0) & (places < 1))
    if wanted and np.all(np.diff([-0.03, *wanted, 1.03]) > 0.06):
        assert places == pytest.approx(wanted)
