"""A design in the loop of a configuration is judged by its matrices alone."""

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.design import Certificate, Check


def test_a_design_that_was_tampered_with_fails(config, designs):
    kalman = designs["kalman"]
    wrong = replace(
        kalman,
        gain_predictor=1.1 * np.asarray(kalman.gain_predictor),
        certificate=Certificate(
            checks=(Check(name="believe me", value=0, limit=1, computed_by="none"),),
            gamma=1.0,
            rms_per_output=np.ones(2),
        ),
    )
    one = lbt.report.design_report(config, {"wrong": wrong}).assessments[0]
    assert not one.certified
    assert "believe me" not in [check.name for check in one.checks]
