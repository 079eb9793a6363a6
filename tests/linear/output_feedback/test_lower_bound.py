"""What a witness proves, and what it does not."""

import numpy as np
import pytest
from support.generalized_plants import random_plant

import lbt_synth as lbt
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.linear.output_feedback.lower_bound import ControlWitness, infeasible_control_level


@pytest.mark.parametrize("seed", [1, 4])
def test_no_controller_is_better_than_proved(seed):
    """Levels proved by arbitrary pairs lie below the norm of every controller."""
    plant = random_plant(seed, D22=False)
    m1, _, p1, _ = plant.sizes
    rng = np.random.default_rng(seed)
    least = lbt.hinf_controller(plant).gamma_least
    for _ in range(20):
        sizes = (len(plant.A), m1), (len(plant.A), p1)
        unseen, unmoved = (
            Witness(states=rng.normal(size=(n, 4)), disturbances=rng.normal(size=(m, 4)))
            for n, m in sizes
        )
        witness = ControlWitness(unseen=unseen, unmoved=unmoved, reason="drawn")
        assert infeasible_control_level(plant, witness) < least * (1 + 1e-9)


def test_nothing_is_proved_by_nothing():
    plant = random_plant(4)
    nothing = ControlWitness(reason="")
    assert infeasible_control_level(plant, nothing) == 0


@pytest.mark.parametrize("size", [1.0, 1e5])
def test_measurements_in_other_units_prove_no_more(size):
    """Both disturbances are measured, and a controller leaves nothing."""
    plant = lbt.linear.GeneralizedPlant(
        A=0.5,
        B1=[[0.5, 0.3]],
        B2=0.0,
        C1=1.0,
        C2=[[size], [1 / size]],
        D12=1.0,
        D21=np.diag([size, 1 / size]),
    )
    pair = Witness(states=np.ones((1, 1)), disturbances=-np.ones((2, 1)))
    witness = ControlWitness(unseen=pair, reason="none")
    assert infeasible_control_level(plant, witness) < 1e-9
