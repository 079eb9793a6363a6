"""The sensor gains that a record allows, and designs at them."""

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.recorded_loops import resonant_record
from support.wrong_commands import record

import lbt_synth as lbt
from lbt_synth.identification.commands.gain_interval import allowed_gains, unstable_gains


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_true_gain_is_allowed(seed) -> None:
    low, high = allowed_gains(record(*ordinary_loop(seed))).T
    assert np.all(low < 0.7)
    assert np.all(high > 0.7)
    assert np.all(high / low < 2)


def test_wide_resonances_are_known_from_a_model() -> None:
    """The coarse spectrum alone explains them by a gain of 1.4 to 2, where the truth is 0.9."""
    resonant = resonant_record()
    assert np.all(allowed_gains(resonant)[:, 0] > 1.3)
    low, high = allowed_gains(resonant, lbt.identify(resonant)).T
    assert np.all(low < 1.3 * 0.9)
    assert np.all(high > 0.9 / 1.3)
    assert np.all(high / low < 1.6)


def test_a_record_that_shows_nothing_allows_everything() -> None:
    y, u = ordinary_loop()
    y = y.copy()
    y[::400] = np.nan
    assert allowed_gains(record(y, u)).tolist() == [[0.08, 2.5]] * 2


def test_gains_at_which_a_loop_is_unstable() -> None:
    """An integrator of gain g is stable below a sensor gain of 1 / g."""
    path = lbt.LoopHardware(frame_rate_hz=1000)
    design = lbt.integrator(path, gain=0.5)
    assert unstable_gains(design, np.array([[0.1, 1.99], [0.2, 1.99]])) is None
    bad = unstable_gains(design, np.array([[0.1, 1.0], [0.2, 2.01]]))
    assert bad is not None
    assert bad[1] == 2.01
