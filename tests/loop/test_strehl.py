"""Strehl ratio against sampled pupils, closed forms and dense integrals."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from scipy.special import j0, jv
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.strehl import annular_otf, series_strehl

CAMERA = lbt.Imaging(diameter_m=8.22, obstruction=0.11)


@pytest.mark.parametrize("obstruction", [0.0, 0.4])
def test_otf_is_the_autocorrelation_of_a_sampled_pupil(obstruction):
    shift = np.arange(-512, 512) / 512  # in D
    radius = np.hypot(*np.meshgrid(shift + 0.5 / 512, shift + 0.5 / 512))
    pupil = ((radius < 0.5) & (radius >= obstruction / 2)).astype(float)
    otf = np.fft.fftshift(np.real(np.fft.ifft2(np.abs(np.fft.fft2(pupil)) ** 2)))
    distance = np.hypot(*np.meshgrid(shift, shift))
    inside = distance < 0.99
    expected = otf[inside] / otf.max()
    assert np.max(np.abs(annular_otf(distance[inside], obstruction) - expected)) < 4e-3


def test_known_value_and_marechal():
    """300 nm an axis leaves .375, where Marechal says .230."""
    assert lbt.strehl(np.eye(2) * 300**2, CAMERA) == pytest.approx(0.375, abs=1e-3)
    still = lbt.strehl(np.zeros((2, 2)), imaging=replace(CAMERA, other_modes=0.84))
    assert still == pytest.approx(0.84, rel=1e-12)
    one = lbt.strehl([[200.0**2]], CAMERA, line_amplitudes_nm=[[300.0]])
    two = lbt.strehl(np.diag([200.0**2, 0]), CAMERA, line_amplitudes_nm=[[300.0, 0]])
    assert one == pytest.approx(two, rel=1e-12)
    small = lbt.strehl(np.eye(2) * 20**2, CAMERA)
    assert small == pytest.approx(np.exp(-2 * (2 * np.pi * 20 / 2200) ** 2), abs=2e-4)


def test_large_jitter_stays_between_zero_and_one():
    """Asymptotes: a Gaussian blob, and a circle that the image runs round."""
    sigma = 10_000.0
    wide = lbt.strehl(np.eye(2) * sigma**2, CAMERA)
    k = 2 * np.pi * CAMERA.cycles_per_nm * sigma
    inner, outer = (
        trapezoid(x * annular_otf(x, 0.11) * np.exp(-(size**2) * x**2 / 2), x)
        for x, size in ((np.linspace(0, 0.2, 20_001), k), (np.linspace(0, 1, 20_001), 0))
    )
    assert wide == pytest.approx(inner / outer, rel=1e-3)
    circle = lbt.strehl(np.zeros((2, 2)), CAMERA, line_amplitudes_nm=[[sigma, sigma * 1j]])
    assert abs(circle) < 1e-4
    assert lbt.strehl(np.eye(2) * 1e12, CAMERA) == 0  # the image is gone


@settings(max_examples=20)
@given(st.floats(0, 1e6), st.floats(0, 0.9))
def test_a_star_that_jumps_between_two_places(jump_nm, obstruction):
    """The image of an annular pupil at its distance, by Bessel functions."""
    camera = lbt.Imaging(diameter_m=8.22, obstruction=obstruction)
    found = series_strehl([[jump_nm, 0.0], [-jump_nm, 0.0]], camera)
    u = np.pi * camera.cycles_per_nm * jump_nm
    discs = [jv(0, w) + jv(2, w) for w in (u, obstruction * u)]  # 2 J1(w) / w
    expected = ((discs[0] - obstruction**2 * discs[1]) / (1 - obstruction**2)) ** 2
    assert 0 <= found <= 1
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-14)


def dense_strehl(covariance, lines, imaging):
    """The integral by thousands of radii that crowd at the kinks, and 96 directions."""
    eps = imaging.obstruction
    kinks = np.array(sorted({0.0, eps, (1 - eps) / 2, (1 + eps) / 2, 1.0}))
    crowded = np.sin(np.linspace(0, np.pi / 2, 100)) ** 2
    edges = np.unique(kinks[:-1, None] + np.diff(kinks)[:, None] * crowded)
    radius, weight = gauss_panels(edges, 5)
    weight = weight * radius * annular_otf(radius, eps)
    angle = np.pi * np.arange(96) / 96
    f = imaging.cycles_per_nm * np.array([[np.cos(angle)], [np.sin(angle)]]) * radius[:, None]
    factor = np.exp(-2 * np.pi**2 * np.einsum("irk,ij,jrk->rk", f, covariance, f))
    for line in lines:
        factor = factor * j0(2 * np.pi * np.abs(np.einsum("i,irk->rk", line, f)))
    return imaging.other_modes * float(weight @ factor.mean(axis=1) / weight.sum())


@pytest.mark.parametrize("obstruction", [0.0, 0.11, 0.9])
def test_many_jitters_are_integrated_as_each_of_them(obstruction):
    rng = np.random.default_rng(5)
    camera = replace(CAMERA, other_modes=0.9, obstruction=obstruction)
    roots = 10 ** rng.uniform(0, 3, (60, 1, 1)) * rng.standard_normal((60, 2, 2))
    roots[::2] = 10 ** rng.uniform(0, 3, (30, 1, 1)) * np.eye(2)  # the same in all directions
    covariances = roots @ np.swapaxes(roots, 1, 2)
    real, imaginary = rng.standard_normal((2, 60, 2, 2))
    lines = 10 ** rng.uniform(-1, 2.8, (60, 2, 1)) * (real + 1j * imaginary)
    covariances[7] = covariances[9]
    largest = np.sqrt(np.max(np.diagonal(covariances, axis1=1, axis2=2), axis=1))
    small = (largest + np.abs(lines).sum(axis=(1, 2))) * camera.cycles_per_nm < 5
    assert small.sum() > 40
    covariances, lines = covariances[small], lines[small]
    many = lbt.strehl(covariances, camera, line_amplitudes_nm=lines)
    for strehl, covariance, line in zip(many, covariances, lines, strict=True):
        assert strehl == pytest.approx(dense_strehl(covariance, line, camera), abs=2e-9)
        alone = lbt.strehl(covariance, camera, line_amplitudes_nm=line)
        assert alone == pytest.approx(strehl, abs=1e-14)


def test_wrong_input_is_refused(config):
    jitter, lines = partial(lbt.strehl, imaging=CAMERA), np.zeros((2, 1, 2))
    calls = [partial(jitter, wrong) for wrong in (np.eye(3), [[1, 0], [0, -1]], [[np.nan]])]
    calls += [partial(jitter, [[1.0]], line_amplitudes_nm=[[np.inf]])]
    calls += [partial(jitter, np.zeros((3, 2, 2)), line_amplitudes_nm=lines)]
    series = np.zeros((10, 3)), np.zeros(10), [[np.nan, 1]]
    calls += [partial(series_strehl, wrong, CAMERA) for wrong in series]
    calls += [partial(lbt.Imaging, diameter_m=d, other_modes=m) for d, m in ((8, 1.2), (0, 1))]
    rows = [(call, ProblemError, ".") for call in calls]
    rows += [(partial(jitter, 50.0), ProblemError, r"got float. Try \[\[rms_nm")]
    rows += [(partial(lbt.strehl, [[1.0]], config), ProblemError, "imaging must .* config.imaging")]
    require_refusals(rows)
