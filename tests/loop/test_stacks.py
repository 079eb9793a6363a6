"""How a loop is split into independent parts."""

import numpy as np
import pytest
from support.ensembles import AIR, LINE, RATE, plant

import lbt_synth as lbt
from lbt_synth.loop.ensemble import textbook_matrices
from lbt_synth.loop.stacks import split_into_parts


def test_a_loop_is_split_into_parts(kalman, coupled):
    # an axis without a vibration is another part than one with
    uneven = lbt.kalman(plant(vibrations=[LINE]))
    for design, modes in ((kalman, [[[0], [1]]]), (coupled, [[[0, 1]]]), (uneven, [[[0]], [[1]]])):
        parts, rest = split_into_parts(textbook_matrices([design.controller]), design.hardware)
        assert [own.tolist() for own, *_ in parts] == modes
        assert rest == []


def test_states_in_odd_units_stay_coupled(coupled):
    """The same controller in states of 1e9 times other units is the same controller."""
    k = coupled.controller
    units = 10.0 ** np.linspace(-9, 9, k.n_states)
    odd = lbt.Controller(
        A=k.A * units / units[:, None], B=k.B / units[:, None], C=k.C * units, D=k.D, dt_s=k.dt_s
    )
    ensemble = lbt.loop.LoopEnsemble(sensor_gain=[0.5, 1.0], noise_nm=15.5, turbulence=AIR)
    one, other = (lbt.loop.ensemble_residuals(c, coupled.hardware, ensemble) for c in (k, odd))
    assert other.rms_nm == pytest.approx(one.rms_nm, rel=1e-8)


def test_a_state_that_no_mode_sees_counts_for_stability():
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    for pole, stable in ((0.5, True), (1.1, False)):
        hidden = lbt.Controller(
            A=np.diag([1.0, pole]), B=[[0.3], [0.0]], C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE
        )
        found = lbt.loop.ensemble_residuals(
            hidden, path, lbt.loop.LoopEnsemble(noise_nm=[1.0, 2.0])
        )
        assert found.stable.tolist() == [stable] * 2
