"""Problems on which other programs failed, hung, or gave no reason: solved, or the reason named.

python-control's issues 152, 367 and 973, and those of Octave's control package, 13 and 14.
"""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy.linalg import block_diag

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError
from lbt_synth.linear import GeneralizedPlant, mixed_sensitivity

MASS = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])


def test_spring_and_mass_with_a_static_weight():
    """python-control 367: D12 is zero where the frequency is infinite."""
    tf = control.tf(
        [[[-1], [-1]], [[0], [1]], [[-1], [-1]]],
        [[[1, 1], [1, 12, 20]], [[1], [1]], [[1, 1], [1, 12, 20]]],
    )
    design = lbt.hinf_controller(GeneralizedPlant.of(control.ss(tf), measurements=1, controls=1))
    assert design.gamma_infeasible > 0.999 * design.gamma_least


def test_weight_that_asks_for_the_highest_frequencies():
    """python-control 152: the sensitivity tends to one, and its weight to 1 / 1.25."""
    plant = control.ss(
        [[-0.01, -0.992], [0, -0.75]],
        [[0.992, 0], [0, 1]],
        [[1, -0.8], [0, -1]],
        [[0.8, 0], [1, 0]],
    )
    design = lbt.hinf_controller(GeneralizedPlant.of(plant, measurements=1, controls=1))
    assert design.gamma == pytest.approx(0.8, rel=1e-6)
    assert design.gamma_infeasible == pytest.approx(0.8, rel=1e-6)
    assert design.witness.reason.endswith("the highest frequencies")


def test_mixed_sensitivity_that_hung():
    """python-control 973: again the weight at the highest frequencies, 2 / 3."""
    G, weight = control.tf([1, 1], [1, 0.5, 4]), control.tf([2, -2.2, 1], [3, 0.2, 0.01])
    design = lbt.hinf_controller(mixed_sensitivity(G, performance=weight))
    assert design.gamma == pytest.approx(2 / 3, rel=1e-5)
    assert design.gamma_infeasible == pytest.approx(2 / 3, rel=1e-5)


def test_copies_of_a_plant_that_no_control_reaches():
    """Octave 13: four copies of a mass; the disturbance has one of its own."""
    A, B, C = MASS
    none, two = np.zeros((2, 1)), np.vstack([C, 0 * C])
    parts = [(B, none), (none, B), (B, none), (none, B)]
    plant = GeneralizedPlant(
        A=block_diag(A, A, A, A),
        B1=np.vstack([first for first, _ in parts]),
        B2=np.vstack([second for _, second in parts]),
        C1=np.hstack([two, two, 0 * two, 0 * two]),
        C2=np.hstack([0 * C, 0 * C, C, C]),
        D12=[[0.0], [1.0]],
        dt_s=None,
    )
    with pytest.raises(DetectabilityError, match="mode at 0 does not decay, and no control") as got:
        lbt.hinf_controller(plant)
    assert np.argmax(got.value.eigenvector) in (1, 5)  # the velocities of the copies


def test_mass_without_noise():
    """Octave 14, without its weights: the measurement has no noise, and D21 is zero."""
    A, B, C = MASS
    plant = GeneralizedPlant(
        A=A,
        B1=B,
        B2=B,
        C1=np.vstack([C, 0 * C]),
        C2=C,
        D12=[[0.0], [1.0]],
        dt_s=None,
    )
    design = lbt.hinf_controller(plant)
    assert design.gamma_infeasible == pytest.approx(1.0, abs=1e-5)  # u must balance w at 0 Hz
    assert design.gamma == pytest.approx(1.0, abs=1e-3)
