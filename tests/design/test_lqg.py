"""LQG for a mirror with dynamics: the limit, generic Riccati solvers, the loop itself, and
certificates that fail."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize
from support.lqg import shell, slow_plant
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.lqg import estimation_plant, loop_variances
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.report.figures.studies import mirror_figure


def model_rms(plant, controller):
    """Residual of a controller where the plant's model is the truth [nm]."""
    return np.sqrt(loop_variances(plant, estimation_plant(plant), controller)[0])


@pytest.mark.parametrize("delay", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("modes", [1, 2])
def test_a_settled_mirror_gives_the_kalman_controller(delay, modes):
    plant = slow_plant(delay, modes=modes)
    design, kalman = lbt.lqg(plant), lbt.kalman(plant)
    for name in "ABCD":
        np.testing.assert_array_equal(
            getattr(design.controller, name), getattr(kalman.controller, name)
        )
    assert design.rms == pytest.approx(kalman.rms, rel=1e-12)


@pytest.mark.parametrize("delay", [1.0, 1.35, 2.0, 2.25, 2.5, 2.75, 2.999, 3.0])
@pytest.mark.parametrize("bandwidth", [None, 60.0, 100.0, 500.0])
def test_it_reaches_the_limit_of_any_linear_controller(delay, bandwidth):
    if bandwidth is None and delay == 2.5:
        return  # a zero on the circle: the limit is only approached
    plant = slow_plant(delay, None if bandwidth is None else shell(bandwidth))
    design = lbt.lqg(plant)
    limit = least_model_residual(plant).rms_nm
    assert design.rms == pytest.approx(limit, rel=1e-9)
    assert design.objective_nm == pytest.approx(limit, rel=1e-9)
    assert model_rms(plant, design.controller) == pytest.approx(limit, rel=1e-9)
    # not worse than the interpolated target, nor than one that forgets the mirror in between
    assert design.rms <= model_rms(plant, lbt.kalman(plant).controller) * (1 + 1e-9)


def test_a_zero_on_the_circle_is_approached_with_a_small_weight():
    plant = slow_plant(2.5)
    with pytest.raises(lbt.errors.InfeasibleError, match="no zero on the unit circle"):
        lbt.lqg(plant)
    limit = least_model_residual(plant).rms_nm
    excess = [lbt.lqg(plant, command_weight=w).rms / limit - 1 for w in (1e-2, 1e-3, 1e-4)]
    assert excess[0] > excess[1] > excess[2] > 0
    assert excess[2] < 1e-3


@given(
    bandwidth=st.floats(50, 600),
    delay=st.floats(1, 3.5),
    weight=st.floats(0, 0.3),
    late=st.integers(0, 5),
)
@settings(max_examples=25)
def test_against_a_generic_riccati_equation_of_all_states(bandwidth, delay, weight, late):
    """One equation over [disturbance, mirror], for scipy, in place of one of the mirror alone."""
    plant = slow_plant(delay, shell(bandwidth, delay_samples=late))
    weight += 1e-3
    design = lbt.lqg(plant, command_weight=weight)
    own, core = design.estimation, plant.hardware.mirror_system.core
    n, c = own.n_states, core.n_states
    A = np.zeros((n + c, n + c))
    A[:n, :n], A[n:, n:] = own.A, core.A
    B = np.concatenate([np.zeros(n), core.B])[:, None]
    row = np.concatenate([own.L[0], -core.C])
    R, S = np.array([[core.D**2 + weight]]), -core.D * row[:, None]
    X = solve_discrete_are(A, B, np.outer(row, row), R, s=S)
    gain = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T)[0]
    law = np.concatenate([design.gain_state[0], -design.gain_mirror])
    np.testing.assert_allclose(-gain, law, rtol=1e-5, atol=1e-6 * np.abs(law).max())


def test_no_other_gain_costs_less():
    """Perturbed gains of the regulator, in the real loop."""
    plant = slow_plant(2.25, shell())
    design = lbt.lqg(plant, command_weight=0.01)
    from lbt_synth.design.lqg import lqg_controller

    def cost(x):
        changed = lqg_controller(
            plant,
            design.gain_predictor,
            design.gain_state * (1 + x[0]) + x[1] * np.eye(1, design.gain_state.shape[1]),
            design.gain_mirror * (1 + x[2]),
        )
        loop = lbt.close_loop(plant.hardware, changed)
        if not loop.is_stable:
            return 1e12
        residual, commands = loop_variances(plant, design.estimation, changed)
        return residual + 0.01 * commands

    best = minimize(cost, np.zeros(3), method="Nelder-Mead", options={"maxfev": 60})
    assert cost(np.zeros(3)) == pytest.approx(design.objective_nm**2, rel=1e-9)
    assert best.fun >= design.objective_nm**2 * (1 - 1e-9)


def test_the_exact_residual_is_that_of_a_simulation():
    plant = slow_plant(2.25, shell(), vibrations=None)
    design = lbt.lqg(plant)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    run = lbt.simulate(
        design.controller, truth, hardware=plant.hardware, frames=40_000, seed=4, cases=4
    )
    assert np.sqrt(np.mean(run.rms_nm**2)) == pytest.approx(design.rms, rel=0.01)
    exact = lbt.residual_budget(lbt.close_loop(plant.hardware, design.controller), truth)
    assert exact.rms_nm == pytest.approx(design.rms, rel=1e-9)
    assert lbt.loop.least_residual(plant.hardware, truth).rms_nm == pytest.approx(
        design.rms, rel=1e-9
    )


def test_coupled_matrices_and_redundant_commands():
    sensor = np.array([[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]])
    influence = np.array([[1.0, 0.1, 0.4], [-0.2, 0.9, 0.3]])
    plant = slow_plant(2.25, shell(), modes=2, sensor_matrix=sensor, influence_matrix=influence)
    design = lbt.lqg(plant)
    assert design.certificate.passed
    assert design.controller.C.shape[0] == 3
    assert design.rms == pytest.approx(model_rms(plant, design.controller), rel=1e-9)


def test_what_is_left_of_the_settled_mirror():
    """Against the difference of two series of positions, tap by tap."""
    plant = slow_plant(2.0, shell(), vibrations=None)
    design = lbt.lqg(plant)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    loop = lbt.close_loop(plant.hardware, design.controller)
    left = lbt.loop.settling_error(loop, truth)
    run = lbt.simulate(
        design.controller, truth, hardware=plant.hardware, frames=60_000, seed=1, cases=2
    )
    taps = plant.hardware.mirror_taps
    missed = []
    for u in run.commands[:, :, 0]:
        real = np.convolve(u, taps)[: u.size]
        missed.append((np.concatenate([[0], u[:-1]]) - real)[taps.size :])
    assert np.std(missed) == pytest.approx(left.rms_nm, rel=0.01)
    # a sinusoid by hand
    shake = lbt.Truth(
        turbulence=None,
        noise_nm=0.0,
        vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100, direction=(1,)),),
    )
    z = np.exp(2j * np.pi * 20 / 800)
    change = z**-1 - np.sum(taps * z ** -np.arange(taps.size))
    command = loop.system.frequency_response([20.0])[0, 1, 0] * 100 * np.sqrt(2)
    assert abs(lbt.loop.settling_error(loop, shake).line_amplitudes_nm[0, 0]) == pytest.approx(
        abs(change * command), rel=1e-9
    )


def test_a_settled_mirror_leaves_nothing():
    plant = slow_plant(2.25)
    loop = lbt.close_loop(plant.hardware, lbt.lqg(plant).controller)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    assert lbt.loop.settling_error(loop, truth).rms_nm == 0


def test_the_other_designs_and_analyses_take_a_moving_mirror():
    plant = slow_plant(2.25, shell(300.0), modes=2)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    made = {
        "kalman": lbt.kalman(plant),
        "hinf": lbt.hinf(plant, gamma_ratio=1.3, route="riccati"),
        "integrator": lbt.design.optimal_integrator(plant.hardware, truth),
        "lqg": lbt.lqg(plant),
    }
    limit = lbt.loop.least_residual(plant.hardware, truth).rms_nm
    for design in made.values():
        loop = lbt.close_loop(plant.hardware, design.controller)
        assert loop.is_stable
        assert lbt.residual_budget(loop, truth).rms_nm >= limit * (1 - 1e-9)
    assert lbt.loop.stable_sensor_gains(plant.hardware, made["integrator"].controller)[1] > 1
    found = lbt.studies.robustness_map(
        made["lqg"],
        truth,
        lbt.Imaging(diameter_m=8.22),
        errors_hz=[0.0],
        sensor_gains=[1.0],
        delay_errors_frames=[0.0, 0.1],
    )
    assert found.stable.all()
    late = replace(plant.hardware, delay_frames=2.35)
    exact = lbt.residual_budget(lbt.close_loop(late, made["lqg"].controller), truth)
    assert found.residual_nm[1, 0, 0] == pytest.approx(exact.rms_nm, rel=1e-6)


def test_shaping_takes_a_moving_mirror_and_refuses_its_delay_errors():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell(300.0))
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    objective = lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=20.0)
    demands = [lbt.design.shaping.ModulusMargin(at_least=0.5)]
    spec = lbt.design.shaping.Specification(objective=objective, demands=demands)
    design = lbt.design.shape(path, spec, functions=25, states=None)
    assert lbt.loop_margins(lbt.close_loop(path, design.controller)).modulus > 0.5
    free = lbt.lqg(
        lbt.tip_tilt_plant(
            frame_rate_hz=800, turbulence=slow, noise_nm=20.0, modes=1, mirror=path.mirror
        )
    )
    assert design.objective_nm[0] >= free.rms
    with pytest.raises(lbt.errors.ProblemError, match="mirror that settles at once"):
        lbt.design.shape(
            path,
            lbt.design.shaping.Specification(
                objective=objective, demands=[lbt.design.shaping.DelayError(frames=0.2)]
            ),
        )


def test_wrong_arguments_are_refused():
    plant = slow_plant(2.0, shell())
    with pytest.raises(lbt.errors.ProblemError, match="plant must be a TipTiltPlant"):
        lbt.lqg(plant.full())
    with pytest.raises(lbt.errors.ProblemError, match="command_weight must be at least 0"):
        lbt.lqg(plant, command_weight=-1.0)
    flat = slow_plant(2.0, shell(), modes=2, influence_matrix=[[1.0], [0.5]])
    with pytest.raises(lbt.errors.DimensionError, match="must have rank 2"):
        lbt.lqg(flat)
    with pytest.raises(lbt.errors.ProblemError, match="plant must be a TipTiltPlant"):
        lbt.studies.mirror(plant.full(), lbt.Truth(turbulence=None), lbt.Imaging(diameter_m=8))
    with pytest.raises(lbt.errors.ProblemError, match="settles at once"):
        mirror_figure(lbt.LoopHardware(frame_rate_hz=800))


def test_complex_zeros_outside_the_circle_have_no_limit():
    """A mode with little damping, sampled slowly."""
    truth = lbt.Truth(turbulence=lbt_axis_plant().turbulence[0], noise_nm=15.5)
    rng, refused = np.random.default_rng(0), 0
    for _ in range(200):
        mirror = lbt.models.PositionLoop(
            natural_frequency_hz=rng.uniform(50, 2000),
            damping=rng.uniform(0.01, 0.1),
            proportional_per_s2=0.0,
            derivative_per_s=0.0,
        )
        path = lbt.LoopHardware(
            frame_rate_hz=800, delay_frames=rng.uniform(2, 3), modes=1, mirror=mirror
        )
        zeros = path.mirror_system.core.zeros
        late = zeros[np.abs(zeros) > 1]
        if np.any(np.abs(late.imag) > 1e-6):
            refused += 1
            with pytest.raises(lbt.errors.ProblemError, match="real zeros outside the unit circle"):
                lbt.loop.least_residual(path, truth)
    assert refused > 0


def test_other_disturbances_meet_the_same_loop():
    plant = slow_plant(2.25, shell())
    design = lbt.lqg(plant)
    moved = retuned_plant(plant, 2.0)
    assert astuple(moved.hardware.mirror) == astuple(plant.hardware.mirror)
    error = design.error_system(moved)
    from lbt_synth.linear.lyapunov import stationary_covariance

    X = stationary_covariance(error.A, error.B @ error.B.T)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5, vibrations=moved.vibrations)
    budget = lbt.residual_budget(lbt.close_loop(plant.hardware, design.controller), truth)
    assert np.sqrt(error.C @ X @ error.C.T)[0, 0] == pytest.approx(budget.rms_nm, rel=1e-8)
    with pytest.raises(lbt.errors.ProblemError, match="problem must be a TipTiltPlant"):
        design.error_system(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    with pytest.raises(lbt.errors.ProblemError, match="must have 4 states"):
        design.error_system(slow_plant(2.25, shell(), vibrations=None))


@pytest.mark.parametrize("field", ["gain_predictor", "gain_state", "gain_mirror", "objective_nm"])
def test_changed_gains_fail_the_certificate(field):
    design = lbt.lqg(slow_plant(2.0, shell()))
    assert design.recertify().passed
    value = getattr(design, field) * (1 + 1e-4)
    given = {field: value}
    if field in design.claims:
        given = {"claims": {**design.claims, **given}}
    changed = replace(design, **given)
    certificate = changed.recertify()
    assert not certificate.passed
    with pytest.raises(lbt.errors.CertificateError):
        certificate.require()


def test_a_controller_cannot_be_given_to_a_design():
    design = lbt.lqg(slow_plant(2.0, shell()))
    with pytest.raises(ValueError, match="controller"):
        replace(design, controller=design.controller)
