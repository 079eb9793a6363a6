"""Frequency responses, and the way to python-control and back."""

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st
from support.systems import random_system

import lbt_synth as lbt
from lbt_synth.linear.state_space import balancing_scales


def test_round_trip_through_python_control():
    A, B, C, D = random_system(4, 5, 2, 3, 0.9)
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D, dt_s=0.002)
    back = lbt.linear.StateSpace.of(system.to_control())
    for name in "ABCD":
        assert np.array_equal(getattr(back, name), getattr(system, name))
    assert back.dt_s == 0.002


def test_systems_of_python_control_and_scipy():
    assert lbt.linear.StateSpace.of(control.tf([1.0], [1.0, 0.5], 0.1)).dt_s == 0.1
    assert lbt.linear.StateSpace.of(control.tf([1.0], [1.0, 0.5], True)).dt_s == 1.0
    assert lbt.linear.StateSpace.of(scipy.signal.dlti([1.0], [1.0, 0.5], dt=0.2)).dt_s == 0.2
    with pytest.raises(lbt.errors.ProblemError, match="a system must be"):
        lbt.linear.StateSpace.of(3.0)


def test_a_continuous_system_is_refused_with_the_map_that_keeps_its_norm():
    """The norm of s / (s + 1) is one; a zero-order hold of half a second makes it 1.24."""
    lead = control.tf([1.0, 0.0], [1.0, 1.0])
    for system in (lead, control.ss(lead), scipy.signal.lti([1.0, 0.0], [1.0, 1.0])):
        with pytest.raises(lbt.errors.ProblemError, match=r'sample_system\(.*method="bilinear"\)'):
            lbt.linear.StateSpace.of(system)
    kept = control.sample_system(control.ss(lead), 0.5, method="bilinear")
    held = control.sample_system(control.ss(lead), 0.5)
    assert float(lbt.hinf_norm(kept)) == pytest.approx(1.0, rel=1e-9)
    assert float(lbt.hinf_norm(held)) == pytest.approx(2 / (1 + np.exp(-0.5)), rel=1e-9)


def test_frequency_response_against_python_control():
    A, B, C, D = random_system(7, 5, 2, 3, 0.9)
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D, dt_s=0.002)
    f = np.linspace(0.0, 250, 40)
    expected = np.moveaxis(system.to_control()(np.exp(2j * np.pi * f * 0.002)), 2, 0)
    assert np.allclose(system.frequency_response(f), expected, rtol=1e-10)


@pytest.mark.parametrize("n", [2, 5, 12])
def test_frequency_responses_of_defective_matrices(n):
    """A Jordan block at 0.9, turned at random: no basis of eigenvectors, a closed form."""
    turn = np.linalg.qr(np.random.default_rng(n).standard_normal((n, n)))[0]
    block = 0.9 * np.eye(n) + np.eye(n, k=1)
    system = lbt.linear.StateSpace(
        A=turn @ block @ turn.T, B=turn[:, -1:], C=turn[:, :1].T, D=[[0.0]], dt_s=1.0
    )
    frequency = np.linspace(0.1, 0.5, 5000)
    z = np.exp(2j * np.pi * frequency)
    response = system.frequency_response(frequency)[:, 0, 0]
    assert np.max(np.abs(response * (z - 0.9) ** n - 1)) < 1e-9


@given(seed=st.integers(0, 100_000), n=st.integers(1, 9), m=st.integers(1, 4), p=st.integers(1, 4))
def test_many_points_and_few_points_agree(seed, n, m, p):
    A, B, C, D = random_system(seed, n, m, p, 0.95)
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D)
    frequency = np.linspace(0, 0.5, 101)
    many = system.frequency_response(frequency)
    few = np.concatenate([system.frequency_response(frequency[i : i + 1]) for i in range(101)])
    assert np.allclose(many, few, rtol=1e-10, atol=1e-10 * np.abs(few).max())
    sigma = np.linalg.svd(few, compute_uv=False)[:, 0]
    assert np.allclose(lbt.linear.largest_singular_values(system, frequency), sigma, rtol=1e-10)


def test_a_pole_on_the_unit_circle_has_no_response():
    integrator = lbt.linear.StateSpace(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt_s=0.1)
    for frequency in ([0.0], np.linspace(0, 5, 50)):
        with pytest.raises(lbt.errors.ProblemError, match="pole at 0 Hz, on the unit circle"):
            integrator.frequency_response(frequency)
    assert np.isfinite(integrator.frequency_response(np.linspace(0.1, 5, 50))).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_measurement_that_is_not_finite_is_refused_and_leaves_the_state(bad):
    run = lbt.Controller(A=[[1.0]], B=[[0.5, 0.0]], C=[[1.0]], D=[[0.0, 0.0]]).start()
    run.step([1.0, 0.0])
    with pytest.raises(lbt.errors.NonFiniteError, match="Hold the last command"):
        run.step([0.0, bad])
    assert run.step([1.0, 0.0]) == 1.0
    run.reset()
    assert run.step([1.0, 0.0]) == 0.5


def test_states_of_very_different_sizes_are_balanced_without_a_warning():
    state, outside = balancing_scales(np.array([[0.5]]), np.array([1e60]), np.array([1e-60]))
    assert 0.1e60 < state / outside < 10e60
