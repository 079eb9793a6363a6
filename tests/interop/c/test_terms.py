"""The terms of exported C source of several sensors: of a design, in a run, proved."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.c.terms import RunningSource, as_computed, source_terms
from lbt_synth.interop.proof import prove_written, rehearsal_error


@pytest.fixture(scope="module")
def terms(sensors_design):
    return source_terms(sensors_design)


def test_single_precision_is_that_of_the_source(terms):
    rounded = terms.rounded()
    names = ("transition", "innovation", "command")
    pairs = [(getattr(rounded, name), getattr(terms, name)) for name in names]
    pairs += [(rounded.gains[missing], gains) for missing, gains in terms.gains.items()]
    assert all(np.array_equal(single, exact.astype(np.float32)) for single, exact in pairs)
    assert np.any(rounded.transition != terms.transition)
    with pytest.raises(ProblemError, match=r"single precision; got 1e\+39"):
        replace(terms, gains={frozenset(): np.full((2, 1, 6), 1e39)}).rounded()


def test_the_proof_is_of_the_loop_around_the_terms(sensors_design, terms):
    """Stable alone, too: what is left of the state where neither readings nor commands come."""
    proof = prove_written(sensors_design, as_computed(sensors_design, terms))
    checks = {check.name: check for check in proof}
    assert len(checks) == 5
    assert all(check.passed for check in checks.values())
    loop = lbt.close_loop(sensors_design.hardware, sensors_design)
    radius = checks["spectral radius with all sensors"].value
    assert radius == pytest.approx(loop.system.radius_per_frame, rel=1e-9)
    certified = next(c for c in sensors_design.certificate.checks if "any loop" in c.name)
    worst = checks["spectral radius with any sensors missing"].value
    assert worst == pytest.approx(certified.value, rel=1e-9)
    losses = [check.value for name, check in checks.items() if name.endswith("loss")]
    assert losses == pytest.approx([0, 0], abs=1e-9)  # those of the controllers of the design


ONLY_M1 = frozenset({"m1"})
LOST = "residual with any sensors missing, loss"
UNSTABLE = "spectral radius with any sensors missing"


@pytest.mark.parametrize(
    ("missing", "factor", "failed"),
    [
        (frozenset(), 1.05, {"residual with all sensors, loss"}),
        (ONLY_M1, 1.3, {LOST}),
        (ONLY_M1, 6.0, {LOST, UNSTABLE}),
    ],
)
def test_other_gains_fail(sensors_design, terms, missing, factor, failed):
    gains = {some: own * (factor if some == missing else 1) for some, own in terms.gains.items()}
    checks = prove_written(sensors_design, as_computed(sensors_design, replace(terms, gains=gains)))
    assert failed <= {check.name for check in checks if not check.passed}
    others = "any sensors missing" if not missing else "all sensors"
    assert all(check.passed for check in checks if others in check.name)


@pytest.mark.usefixtures("short_rehearsal")
def test_the_rehearsal_sees_each_filter(sensors_design, terms):
    assert rehearsal_error(sensors_design, RunningSource(terms)) < 1e-11
    for missing in [(), ("wavefront",), ("slow",), ("m1",), ("m2",)]:
        gains = dict(terms.gains)
        gains[frozenset(missing)] = 1.01 * gains[frozenset(missing)]
        off = rehearsal_error(sensors_design, RunningSource(replace(terms, gains=gains)))
        assert off > 1e-7
    huge = replace(terms, command=terms.command * 1e37, single=True)
    assert rehearsal_error(sensors_design, RunningSource(huge)) == np.inf
