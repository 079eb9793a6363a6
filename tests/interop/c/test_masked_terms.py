"""The arithmetic of C source of several sensors, and its proof."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.c.masked_terms import masked_rehearsal_error, masked_terms, prove_masked


@pytest.fixture(scope="module")
def terms(sensors_design):
    return masked_terms(sensors_design)


def test_the_terms_make_the_controllers_of_the_design(sensors_design, terms):
    assert terms.gains.keys() == sensors_design.controllers.keys()
    for missing, own in sensors_design.controllers.items():
        found = terms.controller(missing)
        for name in "ABCD":
            theirs = getattr(own, name)
            assert np.allclose(getattr(found, name), theirs, rtol=1e-12, atol=1e-12)


def test_single_precision_is_that_of_the_source(terms):
    rounded = terms.rounded()
    for name in ("transition", "innovation", "command"):
        exact, found = getattr(terms, name), getattr(rounded, name)
        assert np.array_equal(found, exact.astype(np.float32))
    assert np.any(rounded.transition != terms.transition)
    for missing, gains in terms.gains.items():
        assert np.array_equal(rounded.gains[missing], gains.astype(np.float32))
    with pytest.raises(ProblemError, match=r"single precision; got 1e\+39 in gains"):
        replace(terms, gains={frozenset(): np.full((2, 1, 6), 1e39)}).rounded()


def test_the_proof_is_of_the_loop_around_the_terms(sensors_design, terms):
    """Stable alone, too: what is left of the state where neither readings nor commands come."""
    checks = {check.name: check for check in prove_masked(sensors_design, terms)}
    assert len(checks) == 5
    assert all(check.passed for check in checks.values())
    loop = lbt.close_loop(sensors_design.hardware, sensors_design)
    radius = checks["spectral radius with all sensors"].value
    assert radius == pytest.approx(loop.system.radius_per_frame, rel=1e-9)
    certified = next(c for c in sensors_design.certificate.checks if "any loop" in c.name)
    worst = checks["spectral radius with any sensors missing"].value
    assert worst == pytest.approx(certified.value, rel=1e-9)


@pytest.mark.parametrize(
    ("missing", "factor", "failed"),
    [
        (frozenset(), 1.05, ["residual with all sensors, loss"]),
        (frozenset({"m1"}), 1.3, ["residual with any sensors missing, loss"]),
        (
            frozenset({"m1"}),
            6.0,
            ["spectral radius with any sensors missing", "residual with any sensors missing, loss"],
        ),
    ],
)
def test_other_gains_fail(sensors_design, terms, missing, factor, failed):
    gains = {some: own * (factor if some == missing else 1) for some, own in terms.gains.items()}
    checks = prove_masked(sensors_design, replace(terms, gains=gains))
    assert set(failed) <= {check.name for check in checks if not check.passed}
    others = "any sensors missing" if not missing else "all sensors"
    assert all(check.passed for check in checks if others in check.name)


def test_the_rehearsal_sees_each_filter(sensors_design, terms):
    assert masked_rehearsal_error(sensors_design, terms, np.float64) < 1e-11
    for missing in [(), ("wavefront",), ("slow",), ("m1",), ("m2",)]:
        gains = dict(terms.gains)
        gains[frozenset(missing)] = 1.01 * gains[frozenset(missing)]
        off = masked_rehearsal_error(sensors_design, replace(terms, gains=gains), np.float64)
        assert off > 1e-7
    huge = replace(terms, command=terms.command * 1e37)
    assert masked_rehearsal_error(sensors_design, huge, np.float32) == np.inf
