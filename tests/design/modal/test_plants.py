"""Plants of many modes, against those of single ones."""

import numpy as np
import pytest
from support.modal import HUM, LINE, single_plant, some_air

from lbt_synth.design.modal.plants import ModalModels, lines_per_mode


@pytest.mark.parametrize("delay", [1, 2.6, 3])
def test_stacked_plants_are_tip_tilt_plants(delay):
    air, lines = some_air(3), lines_per_mode({2: [LINE, HUM]}, 3)
    stacks = ModalModels(air, lines, np.full(3, 7.0)).plants(delay, np.full(3, 0.8))
    for stack in stacks:
        for j, mode in enumerate(stack.modes):
            plant = single_plant(air, mode, lines[mode], 7.0, 0.8, delay)
            for name in ("A", "Q", "C", "L", "R"):
                assert np.allclose(getattr(stack, name)[j], getattr(plant, name), rtol=1e-12)
