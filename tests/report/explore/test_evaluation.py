"""What is computed at a move, against the functions for one question at a time."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear import largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.report.designs.simulation import exact_spectrum
from lbt_synth.report.explore.evaluation import loop_curves, performance
from lbt_synth.report.explore.exploration import Wish, fulfil
from lbt_synth.report.explore.knobs import list_knobs


@pytest.fixture(scope="module")
def start():
    return lbt.load_config("examples/lbt.yaml")


def at(start, **values):
    return fulfil(Wish(method="kalman", values=values), list_knobs(start), start)[0]


def test_curves_are_those_of_the_loop(start):
    design = lbt.kalman(start.plant)
    loop = lbt.close_loop(start.hardware, design.controller)
    found = loop_curves(design, start)
    grid = found.frequency_hz
    np.testing.assert_allclose(found.rejection, spectral_norms(loop.sensitivity(grid)))
    np.testing.assert_allclose(found.noise_transfer, spectral_norms(loop.noise_transfer(grid)))
    np.testing.assert_allclose(found.error_nm, largest_singular_values(design.error_system(), grid))
    spectrum = exact_spectrum(loop, start.truth, grid, 2048)
    np.testing.assert_allclose(found.spectrum_nm2_hz, spectrum)
    assert sorted(abs(found.poles)) == pytest.approx(sorted(abs(loop.system.poles)))
    nearest = float(np.min(np.abs(found.broken + 1)))  # of the loop gain to -1, on the grid
    assert nearest == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-2)


def test_performance_is_that_of_the_budget(start):
    design, shift = lbt.kalman(start.plant), 1.3
    config = at(start, shift=shift, gain=0.8)
    found = performance("K", design, config, start, shift)
    loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=0.8)
    budget = lbt.residual_budget(loop, config.truth)
    assert found.row.residual_nm == pytest.approx(budget.rms_nm, rel=1e-6)
    assert found.row.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-6)
    assert found.row.modulus == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-6)
    still = at(start, gain=0.8)
    there = lbt.strehl(lbt.residual_budget(loop, still.truth), config.imaging)
    assert float(found.strehls[found.shift_hz == 0][0]) == pytest.approx(there, rel=1e-6)
    assert (found.shift_hz[0], found.shift_hz[-1]) == (-3.5, 3.5)


def test_an_unstable_loop_has_poles_only(start):
    design, config = lbt.kalman(start.plant), at(start, gain=2.4)
    found = loop_curves(design, config)
    assert np.all(np.isnan(found.rejection))
    assert np.all(np.isnan(found.spectrum_nm2_hz))
    assert max(abs(found.poles)) > 1
    left = performance("K", design, config, start, 0.0)
    assert np.isnan([left.row.residual_nm, left.row.strehl, left.row.modulus]).all()
    assert np.isnan(left.strehls).all()


def test_an_integrator_estimates_nothing(start):
    assert loop_curves(start.design("integrator", gain=0.3), start).error_nm is None
