"""Poles of many loops from those of a few, beside eigenvalues of each."""

import numpy as np
import pytest
from scipy.optimize import brentq

import lbt_synth as lbt
from lbt_synth.loop.closed_loop import loop_matrices
from lbt_synth.loop.ensemble import loop_poles as module
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops
from lbt_synth.loop.ensemble.evaluation import textbook_matrices
from lbt_synth.loop.ensemble.loop_poles import loop_poles
from lbt_synth.models.mirror.frame_rate_system import tapped_mirror

LOOPS = 2000
PATH = lbt.LoopHardware(frame_rate_hz=1000, modes=1)


def kalman(lines_hz=()):
    """Return a filter of one axis for turbulence and lines."""
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=50.0, frame_rate_hz=1000)
    vibrations = [
        lbt.Vibration(frequency_hz=hz, damping=0.01, rms_nm=100.0, direction=(1.0,))
        for hz in lines_hz
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=1000, turbulence=slow, vibrations=vibrations or None, noise_nm=15.0, modes=1
    )
    return lbt.kalman(plant)


DESIGNS = {"integrator": lbt.integrator(PATH, gain=0.5), "kalman": kalman()}


def close(design, gain, delay):
    """Close the loops of a design, and return them and their only group."""
    loops = ClosedLoops.of(textbook_matrices([design.controller]), PATH, gain, delay)
    [[group]] = loops.subloops
    return loops, group


def closed(gain, fraction, seed, lines=1):
    """Return matrices and ends of loops of a filter for turbulence and random lines."""
    design = kalman(np.random.default_rng(seed).uniform(10, 200, lines))
    matrices, one = textbook_matrices([design.controller]), np.ones((1, 1))
    ends = [
        loop_matrices(*matrices, mirror=tapped_mirror(np.array(taps)), sensor=one, influence=one)
        for taps in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    ]
    share, g = fraction[:, None, None], gain[:, None, None]
    A0, A1 = (a + share * (b - a) for a, b in zip(ends[0][:2], ends[1][:2], strict=True))
    return A0 + g * A1, [(end[0][0], end[1][0]) for end in ends]


def distances(one, other):
    """Return how far each of one set of numbers is from the nearest of the other, both ways."""
    apart = np.abs(one[:, :, None] - other[:, None])
    return np.maximum(apart.min(axis=2).max(axis=1), apart.min(axis=1).max(axis=1))


@pytest.mark.parametrize(("seed", "lines"), [(seed, 1) for seed in range(8)] + [(8, 6), (9, 15)])
def test_poles_are_those_of_eigenvalues(seed, lines, monkeypatch):
    rng = np.random.default_rng(seed)
    gain, fraction = rng.uniform(0.05, 3.0, LOOPS), rng.uniform(0, 1, LOOPS)
    fraction[:5] = 1e-5 * (seed % 2)  # there is a delay more, or nearly
    A, ends = closed(gain, fraction, seed, lines)
    expected = np.linalg.eigvals(A)
    counts, plain = [], module._eigenvalues
    monkeypatch.setattr(
        module, "_eigenvalues", lambda A: counts.append(len(A)) or plain(A), raising=True
    )
    found = loop_poles(A, gain, fraction, ends)
    assert sum(counts) < LOOPS / 2  # most were continued
    assert np.max(distances(found, expected)) < 1e-7  # twice the poles of the delay
    inside = np.max(np.abs(expected), axis=1) < 1
    assert np.any(inside)
    assert not np.all(inside)
    assert np.array_equal(np.max(np.abs(found), axis=1) < 1, inside)
    real, of_found = (
        np.sum((poles.imag == 0) & (np.abs(poles) > 1e-2), axis=1) for poles in (expected, found)
    )
    assert np.ptp(real) > 0  # pairs meet on the real axis
    assert np.array_equal(of_found, real)


def test_loops_next_to_instability_have_eigenvalues():
    def radius(gain):
        A, _ = closed(np.full(1, gain), np.full(1, 0.5), 3)
        return np.max(np.abs(np.linalg.eigvals(A))) - 1

    limit = brentq(radius, 1.0, 3.0, xtol=1e-14)
    gain = limit * (1 + np.linspace(-1e-7, 1e-7, LOOPS))
    fraction = np.full(LOOPS, 0.5)
    A, ends = closed(gain, fraction, 3)
    assert np.array_equal(loop_poles(A, gain, fraction, ends), np.linalg.eigvals(A))


@pytest.mark.parametrize("name", DESIGNS)
def test_residuals_next_to_instability_are_those_with_eigenvalues(name, monkeypatch):
    """A pole near -1 or 1 that is not seen leaves the panels too long."""
    rng = np.random.default_rng(1)
    ensemble = lbt.loop.LoopEnsemble(
        sensor_gain=rng.uniform(0.5, 4.0, LOOPS),
        delay_frames=rng.uniform(2.0, 2.9, LOOPS),
        noise_nm=15.0,
        turbulence=lbt.Atmosphere(
            seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
        ),
    )
    found = lbt.loop.ensemble_residuals(DESIGNS[name], PATH, ensemble)
    monkeypatch.setattr(module, "_FEWEST", 10**9)
    expected = lbt.loop.ensemble_residuals(DESIGNS[name], PATH, ensemble)
    assert np.array_equal(found.stable, expected.stable)
    assert np.nanmax(expected.noise_nm) > 10 * np.nanmin(expected.noise_nm)
    assert found.noise_nm == pytest.approx(expected.noise_nm, rel=1e-6, nan_ok=True)
    assert found.turbulence_nm == pytest.approx(expected.turbulence_nm, rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("name", DESIGNS)
def test_loops_far_from_all_others_are_no_guesses(name):
    """Most gains are equal; the others say alone what the gain does."""
    gain = np.ones(LOOPS)
    gain[-4:] = 0.2, 3.0, 4.0, 50.0
    delay = np.random.default_rng(0).uniform(2.0, 2.99, LOOPS)
    loops, group = close(DESIGNS[name], gain, delay)
    expected = np.linalg.eigvals(group.A)
    assert np.max(distances(group.poles, expected)) < 1e-7
    assert np.array_equal(loops.stable, np.max(np.abs(expected), axis=1) < 1 - 1e-9)
    assert not loops.stable[-2:].any()


def test_absurd_gains_are_left_to_eigenvalues():
    gain = np.linspace(0.1, 1.0, LOOPS) * 1e300
    loops, _ = close(DESIGNS["integrator"], gain, np.linspace(2.0, 2.9, LOOPS))
    assert not loops.stable.any()


def test_loops_that_are_no_family_have_eigenvalues():
    rng = np.random.default_rng(0)
    A, (one, other) = rng.normal(size=(LOOPS, 5, 5)) / 3, rng.normal(size=(2, 5, 5))
    gain, fraction = rng.uniform(0.5, 1, LOOPS), rng.uniform(0, 1, LOOPS)
    column = np.outer(one[0], other[0])
    for ends in ([(one, column), (one, column)], [(one, 0 * column), (one, 0 * column)]):
        found = loop_poles(A, gain, fraction, ends)
        assert np.array_equal(found, np.linalg.eigvals(A))


def test_poles_that_never_move_may_be_double():
    """A controller with two equal states of which the loop sees none: no disc is small."""
    system = lbt.linear.StateSpace(
        A=np.diag([0.95, 0.95, 0.3]), B=[[1.0], [1.0], [0.2]], C=[[0.2, -0.2, 0.4]], D=[[0.0]]
    )
    matrices = tuple(m[None] for m in (system.A, system.B, system.C, system.D))
    gain = np.linspace(0.1, 5.0, LOOPS)
    loops = ClosedLoops.of(matrices, PATH, gain, np.full(LOOPS, 2.3))
    [[group]] = loops.subloops
    assert np.array_equal(group.poles, np.linalg.eigvals(group.A))


def test_equal_loops_have_equal_poles():
    gain, fraction = np.full(LOOPS, 0.8), np.zeros(LOOPS)
    A, ends = closed(gain, fraction, 1)
    assert np.max(distances(loop_poles(A, gain, fraction, ends), np.linalg.eigvals(A))) < 1e-7
