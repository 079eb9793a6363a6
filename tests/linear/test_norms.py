import control
import numpy as np
import pytest
import slycot
from hypothesis import given, settings
from hypothesis import strategies as st
from support.systems import random_system

import lbt_synth as lbt
from lbt_synth.linear.norms import band_norm, independent_parts, largest_real_part, spectral_norms


@given(
    seed=st.integers(0, 100_000),
    n=st.integers(1, 8),
    m=st.integers(1, 3),
    p=st.integers(1, 3),
    radius=st.sampled_from([0.3, 0.9, 0.999, 1 - 1e-6]),
)
def test_against_slycot(seed, n, m, p, radius):
    A, B, C, D = random_system(seed, n, m, p, radius)
    expected, _ = slycot.ab13dd("D", "I", "N", "D", n, m, p, A, np.eye(n), B, C, D, 1e-12)
    norm = lbt.hinf_norm((A, B, C, D))
    assert float(norm) == pytest.approx(expected, rel=1e-8)
    assert norm.lower <= expected * (1 + 1e-9)
    assert norm.upper >= expected * (1 - 1e-9)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
def test_poles_next_to_the_unit_circle(gap):
    assert float(lbt.hinf_norm(([[1 - gap]], [[1.0]], [[1.0]], [[0.0]]))) == pytest.approx(
        1 / gap, rel=1e-6
    )


def test_poles_at_zero_and_wide_systems():
    delay = np.eye(3, k=-1)
    norm = lbt.hinf_norm((delay, np.eye(3)[:, :1], np.eye(3)[2:], [[0.0]]))
    assert float(norm) == pytest.approx(1, rel=1e-12)
    wide = lbt.hinf_norm(([[0.5]], [[3.0, 4.0]], [[1.0]], [[0.0, 0.0]]))
    assert float(wide) == pytest.approx(10, rel=1e-12)


def test_a_narrow_peak_is_found_and_placed():
    line = lbt.Vibration(frequency_hz=133.7, damping=1e-7, rms_nm=1).ar_model(800)
    a1, a2 = line.coefficients
    system = lbt.linear.StateSpace(
        A=[[a1, a2], [1, 0]], B=[[1], [0]], C=[[1, 0]], D=[[0]], dt_s=1 / 800
    )
    norm = lbt.hinf_norm(system)
    assert norm.peak_frequency_hz == pytest.approx(133.7, rel=1e-6)
    pole = np.exp(2j * np.pi * 133.7 / 800)
    assert norm.value == pytest.approx(
        abs(system.frequency_response([norm.peak_frequency_hz])[0, 0, 0]), rel=1e-12
    )
    assert norm.value == pytest.approx(
        1 / abs((1 - abs(line.coefficients[1]) ** 0.5) * (pole - 1 / pole)), rel=1e-3
    )


def test_zero_and_static_systems():
    assert float(lbt.hinf_norm(([[0.5]], [[0.0]], [[1.0]], [[0.0]]))) == 0
    assert float(lbt.hinf_norm(([[0.5]], [[0.0]], [[1.0]], [[-3.0]]))) == pytest.approx(3)


@given(seed=st.integers(0, 1000), scale=st.floats(1e-6, 1e6))
def test_the_norm_is_homogeneous(seed, scale):
    A, B, C, D = random_system(seed, 4, 2, 2, 0.95)
    one = float(lbt.hinf_norm((A, B, C, D)))
    assert float(lbt.hinf_norm((A, B * scale, C, D * scale))) == pytest.approx(
        one * scale, rel=1e-9
    )


def test_takes_python_control_systems():
    system = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    assert float(lbt.hinf_norm(system)) == pytest.approx(2, rel=1e-9)
    with pytest.raises(lbt.errors.ProblemError, match="must be in discrete time"):
        lbt.hinf_norm(control.ss([[-0.5]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(lbt.errors.ProblemError, match="got str"):
        lbt.hinf_norm("system")


def test_unstable_systems_have_no_norm():
    with pytest.raises(lbt.errors.UnstableLoopError, match="got a pole of modulus 1.5") as caught:
        lbt.hinf_norm(([[1.5]], [[1.0]], [[1.0]], [[0.0]]))
    assert caught.value.spectral_radius == 1.5


def test_a_thousand_systems_against_slycot():
    """AB13DD on 1,000 random stable systems, up to poles of modulus 1 - 1e-6."""
    rng = np.random.default_rng(7)
    worst = 0.0
    for seed in range(1000):
        n, m, p = rng.integers(1, 9), rng.integers(1, 4), rng.integers(1, 4)
        radius = rng.choice([0.3, 0.9, 0.999, 1 - 1e-6])
        A, B, C, D = random_system(seed, n, m, p, radius)
        expected, _ = slycot.ab13dd("D", "I", "N", "D", n, m, p, A, np.eye(n), B, C, D, 1e-12)
        worst = max(worst, abs(float(lbt.hinf_norm((A, B, C, D))) / expected - 1))
    assert worst < 1e-8


def test_what_python_control_cannot_do():
    """Poles at 1 - 1e-9 and at 0, D not square: here the exact values."""
    near = lbt.hinf_norm(([[1 - 1e-9]], [[1e-9]], [[1.0]], [[0.0]]))
    assert float(near) == pytest.approx(1, rel=1e-6)
    delay = (
        np.eye(3, k=1),
        np.eye(3)[:, -1:],
        np.vstack([np.eye(3)[:1], np.zeros(3)]),
        [[0.0], [2.0]],
    )
    assert float(lbt.hinf_norm(delay)) == pytest.approx(np.sqrt(5), rel=1e-12)


@pytest.mark.parametrize("size", [5e-324, 1e-310, 1e-150, 1e300])
def test_norms_of_matrices_of_any_size(size):
    assert spectral_norms(np.full((1, 2, 2), complex(size)))[0] == 2 * size


def test_the_bracket_is_narrow_and_holds():
    A, B, C, D = random_system(3, 6, 2, 2, 0.99)
    norm = lbt.hinf_norm((A, B, C, D))
    assert norm.lower <= norm.value <= norm.upper <= norm.lower * (1 + 1e-10)
    dense = lbt.linear.largest_singular_values(
        lbt.linear.StateSpace(A=A, B=B, C=C, D=D), np.linspace(0, 0.5, 20_001)
    )
    assert dense.max() <= norm.upper


@given(
    seed=st.integers(0, 100_000), n=st.integers(1, 4), scale=st.sampled_from([1e-9, 1e-5, 1e5, 1e9])
)
def test_units_of_states_change_nothing(seed, n, scale):
    """B s, C / s, and each state in units of its own."""
    A, B, C, D = random_system(seed, n, 2, 2, 0.9)
    expected = float(lbt.hinf_norm((A, B, C, D)))
    assert float(lbt.hinf_norm((A, scale * B, C / scale, D))) == pytest.approx(expected, rel=1e-9)
    units = 10.0 ** np.random.default_rng(seed).uniform(-6, 6, n)
    turned = (A * units[:, None] / units, B * units[:, None], C / units, D)
    assert float(lbt.hinf_norm(turned)) == pytest.approx(expected, rel=1e-9)
    frequency = np.linspace(0, 0.5, 201)
    plain = lbt.linear.StateSpace(A=A, B=B, C=C, D=D).frequency_response(frequency)
    scaled = lbt.linear.StateSpace(A=turned[0], B=turned[1], C=turned[2], D=D).frequency_response(
        frequency
    )
    assert np.allclose(scaled, plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())


def test_a_peak_that_units_hid():
    A, s = [[0.7, 0.6], [-0.1, 0.9]], 1e5
    norm = lbt.hinf_norm((A, [[0.1 * s], [-1 * s]], [[-0.8 / s, 0.4 / s]], [[0]]))
    assert float(norm) == pytest.approx(4.48499, abs=1e-5)


# -- peaks over frequency --------------------------------------------------------------------
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_peaks_of_a_band_and_of_the_real_part_against_a_dense_grid(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.99) / np.max(np.abs(np.linalg.eigvals(A)))
    system = lbt.linear.StateSpace(
        A=A, B=rng.normal(size=(n, 1)), C=rng.normal(size=(1, n)), D=rng.normal(size=(1, 1))
    )
    low, high = np.sort(rng.uniform(0, 0.5, 2))
    f = np.linspace(0, 0.5, 20001)
    response = system.frequency_response(f)[:, 0, 0]
    largest = largest_real_part(system)
    size = np.max(np.abs(response))
    assert largest >= np.max(response.real) - 1e-9 * size
    assert largest <= np.max(response.real) + 1e-3 * size
    inside = np.linspace(low, high, 4001)
    dense = np.max(np.abs(system.frequency_response(inside)))
    found = band_norm(system, low, high)
    assert dense * (1 - 1e-10) <= found.upper <= dense * 1.001
    assert low <= found.peak_frequency_hz <= high


@pytest.mark.parametrize("seed", range(4))
def test_the_real_part_of_several_channels_is_the_largest_eigenvalue(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 5))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    B, C, D = rng.normal(size=(5, 3)), rng.normal(size=(3, 5)), rng.normal(size=(3, 3))
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D)
    response = system.frequency_response(np.linspace(0, 0.5, 20001))
    hermitian = (response + response.conj().transpose(0, 2, 1)) / 2
    dense = np.max(np.linalg.eigvalsh(hermitian))
    assert dense - 1e-9 <= largest_real_part(system) <= dense + 1e-3 * abs(dense)


def test_norms_over_a_band():
    lag = lbt.linear.StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt_s=0.01)
    assert band_norm(lag, 0.0, 50.0).value == pytest.approx(lbt.hinf_norm(lag).value, rel=1e-12)
    edge = abs(1 / (np.exp(2j * np.pi * 0.1) - 0.5))
    assert band_norm(lag, 10.0, 50.0).value == pytest.approx(edge, rel=1e-12)
    line = lbt.linear.StateSpace(A=[[1.9, -0.99], [1, 0]], B=[[1.0], [0]], C=[[1.0, 0]], D=[[0.0]])
    whole = lbt.hinf_norm(line)
    f = whole.peak_frequency_hz
    assert band_norm(line, f / 2, 2 * f).value == pytest.approx(whole.value, rel=1e-10)
    below = band_norm(line, 0.0, f / 2)
    assert below.value == pytest.approx(
        float(lbt.linear.largest_singular_values(line, [f / 2])[0]), rel=1e-10
    )


def test_a_pole_within_the_band_has_no_norm():
    walk = lbt.linear.StateSpace(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    with pytest.raises(lbt.errors.NumericalError, match="at 0 Hz is not finite"):
        band_norm(walk, 0.0, 0.5)


@pytest.mark.parametrize("through", [0.0, 3.0])
def test_the_norm_ofindependent_parts_is_the_largest_of_theirs(through):
    """Two equal lags, a third one, a state that nothing moves, and a path without states."""
    poles, gains = [0.5, 0.8, 0.5, 0.99], [1.0, 0.3, 1.0, 0.0]
    B, D = np.diag([1.0, 1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 0.0, through])
    system = lbt.linear.StateSpace(A=np.diag(poles), B=B, C=np.diag(gains), D=D)
    assert len(independent_parts(system)) == (1 if through else 2)
    assert float(lbt.hinf_norm(system)) == pytest.approx(max(2.0, through))
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    mixed = lbt.linear.StateSpace(
        A=turned @ system.A @ turned.T, B=turned @ system.B, C=system.C @ turned.T, D=D
    )
    assert len(independent_parts(mixed)) == 1
    assert float(lbt.hinf_norm(mixed)) == pytest.approx(max(2.0, through))


def test_a_pencil_without_eigenvalues_is_refused_in_words(monkeypatch):
    def fail(*_):
        raise np.linalg.LinAlgError("ggev")

    monkeypatch.setattr("lbt_synth.linear.norms.eigvals", fail)
    with pytest.raises(lbt.errors.NumericalError, match="scale the states"):
        lbt.hinf_norm(lbt.linear.StateSpace(A=0.5, B=1.0, C=1.0, D=0.0, dt_s=1.0))


def test_a_system_without_inputs_or_outputs_has_no_norm():
    blind = lbt.linear.StateSpace(A=[[0.5]], B=[[1.0]], C=np.zeros((0, 1)), D=np.zeros((0, 1)))
    with pytest.raises(lbt.errors.DimensionError, match="one output; got 1 inputs and 0 outputs"):
        lbt.hinf_norm(blind)
