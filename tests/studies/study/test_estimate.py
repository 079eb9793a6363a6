"""What a study will cost."""

from __future__ import annotations

import time

import pytest
from support.studies import evaluate_quickly, load_small_study

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


def test_an_estimate(tmp_path):
    study = load_small_study(tmp_path, samples="5000")

    def slow(study, values, start):
        time.sleep(1e-3 * len(values))
        return evaluate_quickly(study, values, start)

    cost = lbt.studies.estimate_study(study, workers=1, evaluate=slow)
    assert 4 < cost.seconds < 9
    assert cost.measured_rows >= 1000
    far = lbt.studies.estimate_study(study, workers=100, local=False, evaluate=slow)
    assert far.seconds < 0.09
    with pytest.raises(ProblemError, match="workers must be at least 1"):
        lbt.studies.estimate_study(study, workers=0)
