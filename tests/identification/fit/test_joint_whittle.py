"""The joint likelihood of two axes: against matrices, differences and separate likelihoods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.recorded_loops import RATE, open_record

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.joint_whittle import (
    JointPeriodogram,
    JointSearch,
    JointSpectrum,
    Tie,
    joint_contrast,
    joint_density,
    joint_derivatives,
)
from lbt_synth.identification.fit.periodogram import cross_periodogram, loop_periodogram
from lbt_synth.identification.fit.spectrum_model import Component, SpectrumModel
from lbt_synth.identification.fit.whittle import contrast

W = 2 * np.pi / RATE
LINE = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=50, direction=(0.8, -0.6))


def spectrum(*parts: Component) -> SpectrumModel:
    turbulence = Component("turbulence", np.log(1.1 * W), np.log(0.5), np.log(280.0**2))
    return SpectrumModel(0.0, np.log(40), 0.0, np.log(30 * W), (turbulence, *parts))


def line(frequency: float, ratio: float, rms: float) -> Component:
    odds = float(np.log(ratio / (1 - ratio)))
    return Component("line", float(np.log(frequency * W)), odds, 2 * float(np.log(rms)))


@pytest.fixture(scope="module")
def data() -> JointPeriodogram:
    y = open_record(((LINE, 0),), frames=4096).measurements
    options = {"frame_rate_hz": RATE, "stretches": [(0, len(y))]}
    first, second = (loop_periodogram(axis, None, **options) for axis in y.T)
    return JointPeriodogram(axes=(first, second), crossed=cross_periodogram(*y.T, **options))


@pytest.fixture
def tied() -> JointSpectrum:
    first = spectrum(line(70, 0.05, 20), line(41, 0.02, 35))
    second = spectrum(line(41, 0.02, 25))
    return JointSpectrum(axes=(first, second), ties=(Tie(parts=(2, 1), phase=2.5),))


def test_the_likelihood_is_that_of_the_matrices(data, tied):
    density = joint_density(data, tied)
    (first, second), crossed = density.diagonal, density.crossed
    S = np.moveaxis(np.array([[first, crossed], [crossed.conj(), second]]), -1, 0)
    (left, right), seen = data.powers(tied), data.crossed
    seen = np.moveaxis(np.array([[left, seen], [seen.conj(), right]]), -1, 0)
    trace = np.trace(np.linalg.solve(S, seen), axis1=1, axis2=2).real
    value = np.sum(data.axes[0].count * (np.linalg.slogdet(S)[1] + trace))
    assert joint_contrast(data, tied) == pytest.approx(value, rel=1e-12)
    assert joint_derivatives(data, tied)[0] == pytest.approx(value, rel=1e-12)


def test_axes_without_ties_are_separate(data, tied):
    apart = replace(tied, ties=())
    each = zip(data.axes, apart.axes, strict=True)
    assert joint_contrast(data, apart) == pytest.approx(sum(contrast(d, m) for d, m in each))


def test_slopes_are_those_of_differences(data, tied):
    theta, step = tied.pack(), 1e-5
    _, slope, _ = joint_derivatives(data, tied)
    values = [
        joint_contrast(data, tied.unpack(theta + h)) - joint_contrast(data, tied.unpack(theta - h))
        for h in step * np.eye(theta.size)
    ]
    moves = [i for i in range(theta.size) if i not in tied.starts]  # the gains are not fitted
    numeric = np.array(values)[moves] / (2 * step)
    assert slope[moves] == pytest.approx(numeric, rel=1e-4, abs=1e-5 * np.max(np.abs(numeric)))


def test_information_is_the_second_derivative_where_the_data_are_the_model(data, tied):
    density = joint_density(data, tied)
    axes = [
        replace(axis, measured=own) for axis, own in zip(data.axes, density.diagonal, strict=True)
    ]
    pure = JointPeriodogram(axes=(axes[0], axes[1]), crossed=density.crossed)
    theta = tied.pack()
    _, slope, information = joint_derivatives(pure, tied)
    assert slope == pytest.approx(0, abs=1e-7)
    rows = [
        joint_derivatives(pure, tied.unpack(theta + h))[1]
        - joint_derivatives(pure, tied.unpack(theta - h))[1]
        for h in 1e-5 * np.eye(theta.size)
    ]
    exact = np.array(rows) / 2e-5
    for gain in tied.starts:  # it changes the data, too
        exact[gain] = 0
    assert information == pytest.approx(exact, abs=1e-5 * np.max(exact))


def test_what_is_tied_and_what_is_left_when_a_part_goes(tied):
    columns = tied.columns()
    one, other = tied.place(0, 2), tied.place(1, 1)
    assert (columns[one : one + 2] == columns[other : other + 2]).all()
    assert columns[one + 2] != columns[other + 2]
    assert columns.max() + 1 == columns.size - 2
    whole = replace(tied, ties=(replace(tied.ties[0], whole=True),))
    assert whole.columns().max() + 1 == columns.size - 3
    assert tied.unpack(tied.pack()) == tied
    # a part before the tied one goes, or the tied one itself, on both axes
    assert tied.drop(0, 1).ties[0].parts == (1, 1)
    gone = tied.drop(1, 1)
    assert not gone.ties
    assert [len(axis.components) for axis in gone.axes] == [2, 1]
    before = line(42, 0.01, 30)
    kept = replace(tied, ties=(replace(tied.ties[0], before=(before, None)),)).untie(0)
    assert kept.axes[0].components[2] == before
    assert len(kept.axes[1].components) == 1


def test_a_component_that_would_leave_the_band_keeps_its_frequency(data):
    """Noise that falls towards the Nyquist frequency draws a wide component beyond it."""
    searches = tuple(Search(data=each, gain=1.0) for each in data.axes)
    wide = Component("line", np.log(3.1), 0.0, 2 * np.log(20.0))
    start = JointSpectrum(axes=(spectrum(wide), spectrum()), ties=())
    fit = JointSearch(searches=searches, data=data).fit(start)
    assert fit is not None
    found = fit.joint.axes[0].components[-1]
    assert found.frequency < np.pi
