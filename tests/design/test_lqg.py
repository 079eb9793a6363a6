"""LQG for a mirror with dynamics: the limit, other Riccati solvers, small steps, certificates."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, solve_discrete_are
from support.lqg import shell, slow_plant
from support.refusals import require_refusals
from support.shaping import margin, shaped

import lbt_synth as lbt
from lbt_synth.design.lqg import _pieces, loop_variances, mirror_core
from lbt_synth.design.shaping import LoopErrors, ResidualVariance
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop.least_residual import least_residual
from lbt_synth.models import ARModel
from lbt_synth.studies.robustness import compare_on_mirror


def model_rms(plant, controller):
    """Return what a controller leaves in the image where the plant's model is the truth [nm]."""
    return lbt.residual_budget(lbt.close_loop(plant.hardware, controller), plant).rms_nm


@pytest.mark.parametrize(("delay", "modes"), [(1.0, 1), (2.49, 1), (3.0, 2)])
def test_a_settled_mirror_gives_the_kalman_controller_and_reaches_the_limit(delay, modes):
    plant = slow_plant(delay, modes=modes)
    design, kalman = lbt.lqg(plant), lbt.kalman(plant)
    series = np.random.default_rng(0).standard_normal((40, modes))
    runs = design.controller.start(), kalman.controller.start()
    one, other = (np.array([run.step(y) for y in series]) for run in runs)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    assert design.rms == pytest.approx(kalman.rms, rel=1e-12)
    assert design.objective_nm == pytest.approx(kalman.rms, rel=1e-9)
    if delay == int(delay):
        limit = least_residual(plant.hardware, plant)
        assert model_rms(plant, design.controller) == pytest.approx(limit.rms_nm, rel=1e-9)
        means = np.sqrt(np.sum(limit.variance_nm2 - limit.within_nm2))
        assert design.rms == pytest.approx(means, rel=1e-9)


@pytest.mark.parametrize("mirror", [None, shell(60.0), shell(300.0)])
def test_it_is_never_above_kalman_in_the_image(mirror):
    """At half a frame, too, where commands that alternate cancel in the means over frames."""
    plants = [slow_plant(delay, mirror) for delay in (2.0, 2.4, 2.49, 2.5, 2.51, 2.8)]
    lqg, kalman = (
        np.array([model_rms(plant, make(plant).controller) for plant in plants])
        for make in (lbt.lqg, lbt.kalman)
    )
    if mirror is None:
        np.testing.assert_allclose(lqg, kalman, rtol=1e-9)
    else:
        assert np.all(lqg < kalman * (1 - 1e-5))
    # least in means over frames, it left three times as much in the image at 2.49 frames
    assert np.all(np.diff(lqg) > 0)
    assert lqg[-2] < 1.05 * lqg[1]


@pytest.mark.parametrize("delay", [1.35, 2.49, 3.0])
def test_the_pieces_leave_what_the_camera_sees_but_for_what_nobody_follows(delay):
    """The model between two frames is straight: any residual exceeds its own by about the same."""
    plant = slow_plant(delay, shell(), vibrations=())
    designs = lbt.lqg(plant), lbt.lqg(plant, command_weight=0.1), lbt.kalman(plant)
    powers = np.array([model_rms(plant, design.controller) ** 2 for design in designs])
    excess = powers - [loop_variances(plant, design.controller)[0] for design in designs]
    newest = designs[0].estimation.hardware.delay_frames - 1  # between frames, not beyond
    assert newest - 1 <= delay - 0.5 <= newest
    assert min(excess) > 0
    assert np.ptp(excess) < 0.02 * powers[0]


@settings(max_examples=10)
@given(
    bandwidth=st.floats(50, 600),
    delay=st.floats(1, 3.5),
    weight=st.floats(0.001, 0.3),
    late=st.integers(0, 5),
)
def test_against_a_generic_riccati_equation_of_all_states(bandwidth, delay, weight, late):
    """One equation over [disturbance, mirror], for scipy, in place of one of the mirror alone."""
    plant = slow_plant(delay, shell(bandwidth, delay_samples=late))
    design = lbt.lqg(plant, command_weight=weight)
    own, core, pieces = design.estimation, mirror_core(plant), _pieces(plant)
    A = block_diag(own.A, core.A)
    B = np.concatenate([np.zeros(own.n_states), core.B])[:, None]
    rows, direct = np.hstack([pieces.L[:, 0], -pieces.C]), pieces.D[:, None]
    R, S = direct.T @ direct + weight, -rows.T @ direct
    X = solve_discrete_are(A, B, rows.T @ rows, R, s=S)
    gain = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T)[0]
    law = np.concatenate([design.gain_state[0], -design.gain_mirror])
    np.testing.assert_allclose(-gain, law, rtol=1e-5, atol=1e-6 * np.abs(law).max())
    residual, commands = loop_variances(plant, design.controller)
    assert design.objective_nm**2 == pytest.approx(residual + weight * commands, rel=1e-8)


def test_coupled_matrices_and_redundant_commands():
    sensor = [[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]]
    influence = [[1.0, 0.1, 0.4], [-0.2, 0.9, 0.3]]
    plant = slow_plant(2.25, shell(), modes=2, sensor_matrix=sensor, influence_matrix=influence)
    design = lbt.lqg(plant)
    assert design.certificate.passed
    assert design.controller.C.shape[0] == 3
    residual, _ = loop_variances(plant, design.controller)
    assert design.rms == pytest.approx(np.sqrt(residual), rel=1e-9)


def test_the_other_designs_take_a_moving_mirror():
    slow = ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    facts = {"vibrations": (), "turbulence": slow, "noise_nm": 20.0}
    plant = slow_plant(2.25, shell(300.0), **facts)
    truth, path = lbt.Truth(turbulence=slow, noise_nm=20.0), plant.hardware
    terms = [ResidualVariance(turbulence=slow, noise_nm=20.0)]
    robust = shaped(margin(0.5), terms=terms, path=path, functions=25)
    integrator = lbt.integrator(path, truth=truth)
    settled = replace(path, mirror=None, delay_frames=2.0)  # a mirror that is there at once
    limit = lbt.loop.least_residual(settled, truth, frame_means=True).rms_nm
    filters = lbt.lqg(plant), lbt.kalman(plant), lbt.hinf(plant, gamma_ratio=1.3)
    loops = [lbt.close_loop(path, design) for design in (*filters, integrator, robust)]
    means = [lbt.residual_budget(loop, truth, frame_means=True).rms_nm for loop in loops]
    assert min(means) >= limit * (1 - 1e-9)
    least, *residuals = (lbt.residual_budget(loop, truth).rms_nm for loop in loops)
    assert min(residuals) >= least * (1 - 1e-9)
    assert lbt.loop.stable_sensor_gains(path, integrator.controller)[1] > 1
    assert lbt.loop_margins(loops[-1]).modulus > 0.5
    with pytest.raises(ProblemError, match="mirror that settles at once"):
        shaped(LoopErrors(delay_frames=0.2), terms=terms, path=path)


def test_refusals():
    plant, settled = slow_plant(2.0, shell()), lbt.LoopHardware(frame_rate_hz=800)
    design, path = lbt.lqg(plant), plant.hardware
    flat = slow_plant(2.0, shell(), modes=2, influence_matrix=[[1.0], [0.5]])
    facts = lbt.Truth(turbulence=None), lbt.Imaging(diameter_m=8)
    need, weight = "plant must be a TipTiltPlant", "command_weight must be at least 0"
    require_refusals(
        [
            (lambda: lbt.lqg(settled), ProblemError, need),
            (lambda: lbt.lqg(plant, command_weight=-1.0), ProblemError, weight),
            (lambda: lbt.lqg(flat), DimensionError, "must have rank 2"),
            (lambda: compare_on_mirror(path, *facts), ProblemError, need),
            (lambda: replace(design, controller=design.controller), ValueError, "controller"),
        ]
    )
