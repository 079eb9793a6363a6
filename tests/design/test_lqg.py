"""LQG for a mirror with dynamics: the limit, generic Riccati solvers, the loop itself in small
steps, and certificates that fail."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize
from support.continuous_loops import noise_covariance, sinusoid_powers
from support.lqg import shell, slow_plant
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.lqg import _pieces, loop_variances, mirror_core
from lbt_synth.loop.budget import settling_error
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.report.figures.studies import mirror_figure
from lbt_synth.studies.robustness import mirror_rows


def model_rms(plant, controller):
    """Residual of a controller in the image where the plant's model is the truth [nm]."""
    loop = lbt.close_loop(plant.hardware, controller)
    return lbt.residual_budget(loop, plant).rms_nm


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 2.25, 2.49, 3.0, 4.0])
@pytest.mark.parametrize("modes", [1, 2])
def test_a_settled_mirror_gives_the_kalman_controller(delay, modes):
    plant = slow_plant(delay, modes=modes)
    design, kalman = lbt.lqg(plant), lbt.kalman(plant)
    rng = np.random.default_rng(0)
    series = rng.standard_normal((40, modes))
    one, other = (
        np.array([run.step(y) for y in series])
        for run in (design.controller.start(), kalman.controller.start())
    )
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    assert design.rms == pytest.approx(kalman.rms, rel=1e-12)
    assert design.objective_nm == pytest.approx(kalman.rms, rel=1e-9)


@pytest.mark.parametrize("delay", [1.0, 2.0, 3.0])
def test_it_reaches_the_limit_of_any_linear_controller(delay):
    plant = slow_plant(delay)
    design = lbt.lqg(plant)
    limit = least_model_residual(plant)
    assert model_rms(plant, design.controller) == pytest.approx(limit.rms_nm, rel=1e-9)
    means = np.sqrt(np.sum(limit.variance_nm2 - limit.within_nm2))
    assert design.rms == pytest.approx(means, rel=1e-9)


@pytest.mark.parametrize("delay", np.arange(2, 3.01, 0.05).round(2).tolist())
def test_it_is_never_above_kalman_in_the_image(delay):
    """At half a frame, too, where commands that alternate cancel in the means over frames."""
    for mirror in (None, shell(60.0), shell(300.0)):
        plant = slow_plant(delay, mirror)
        left, plain = (
            model_rms(plant, design.controller) for design in (lbt.lqg(plant), lbt.kalman(plant))
        )
        if mirror is None:
            assert left == pytest.approx(plain, rel=1e-9)
        else:
            assert left < plain * (1 - 1e-5)


@pytest.mark.parametrize(("mirror", "grows"), [(None, 1.05), (shell(100.0), 1.05)])
def test_it_does_not_blow_up_next_to_half_a_frame(mirror, grows):
    """Least in means over frames, it left three times as much in the image at 2.49 frames."""
    left = []
    for delay in (2.4, 2.49, 2.5, 2.51):
        plant = slow_plant(delay, mirror)
        left.append(model_rms(plant, lbt.lqg(plant).controller))
    assert np.all(np.diff(left) > 0)
    assert left[-1] < grows * left[0]


@pytest.mark.parametrize("delay", [1.35, 2.25, 2.49, 2.75, 3.0])
def test_the_pieces_leave_what_the_camera_sees_but_for_what_nobody_follows(delay):
    """The model between two frames is a straight line: it lacks what bends.

    The residual of any controller exceeds that in the pieces by almost the same.
    """
    plant = slow_plant(delay, shell(), vibrations=None)
    excess = []
    for design in (lbt.lqg(plant), lbt.lqg(plant, command_weight=0.1), lbt.kalman(plant)):
        residual, _ = loop_variances(plant, design.controller)
        excess.append(model_rms(plant, design.controller) ** 2 - residual)
    newest = lbt.lqg(plant).estimation.hardware.delay_frames - 1  # between frames, not beyond
    assert newest - 1 <= delay - 0.5 <= newest
    assert min(excess) > 0
    assert np.ptp(excess) < 0.02 * model_rms(plant, lbt.lqg(plant).controller) ** 2


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
    own, core, pieces = design.estimation, mirror_core(plant), _pieces(plant)
    n, c = own.n_states, core.n_states
    A = np.zeros((n + c, n + c))
    A[:n, :n], A[n:, n:] = own.A, core.A
    B = np.concatenate([np.zeros(n), core.B])[:, None]
    rows, direct = np.hstack([pieces.L[:, 0], -pieces.C]), pieces.D[:, None]
    R, S = direct.T @ direct + weight, -rows.T @ direct
    X = solve_discrete_are(A, B, rows.T @ rows, R, s=S)
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
        residual, commands = loop_variances(plant, changed)
        return residual + 0.01 * commands

    best = minimize(cost, np.zeros(3), method="Nelder-Mead", options={"maxfev": 60})
    assert cost(np.zeros(3)) == pytest.approx(design.objective_nm**2, rel=1e-9)
    assert best.fun >= design.objective_nm**2 * (1 - 1e-9)


@pytest.mark.parametrize("delay", [2.0, 2.25, 2.49])
def test_the_residual_is_that_of_a_run_in_small_steps(delay):
    """Of waves, by their density in the phase whose means over frames are the process."""
    quick = lbt.models.ARModel(coefficients=[0.7], driving_rms_nm=60.0, frame_rate_hz=800)
    mirror = shell(sampling_hz=8000.0)
    plant = slow_plant(delay, mirror, vibrations=None, turbulence=quick)
    design = lbt.lqg(plant)
    x, weight = np.polynomial.legendre.leggauss(40)
    hertz = 200 * (1 + x)
    powers = sinusoid_powers(plant.hardware, design.controller, hertz, (1.0,), frames=120)
    density = quick.psd(hertz) / np.sinc(hertz / 800) ** 2
    noise = noise_covariance(plant.hardware, design.controller, [15.5], frames=120)
    expected = np.sqrt(200 * weight @ (density * powers[:, 0, 0]) + noise[0, 0])
    assert model_rms(plant, design.controller) == pytest.approx(expected, rel=1e-4)
    truth = lbt.Truth(turbulence=quick, noise_nm=15.5)
    loop = lbt.close_loop(plant.hardware, design.controller)
    assert lbt.residual_budget(loop, truth).rms_nm == pytest.approx(expected, rel=1e-4)


def test_means_over_frames_are_those_of_a_simulation():
    plant = slow_plant(2.25, shell(), vibrations=None)
    design = lbt.lqg(plant)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    run = lbt.simulate(
        design.controller,
        truth,
        hardware=plant.hardware,
        frames=40_000,
        seed=4,
        cases=4,
        frame_means=True,
    )
    loop = lbt.close_loop(plant.hardware, design.controller)
    exact = lbt.residual_budget(loop, truth, frame_means=True)
    assert np.sqrt(np.mean(run.rms_nm**2)) == pytest.approx(exact.rms_nm, rel=0.01)
    least = lbt.loop.least_residual(plant.hardware, truth, frame_means=True)
    assert least.rms_nm < exact.rms_nm < 1.1 * least.rms_nm


def test_coupled_matrices_and_redundant_commands():
    sensor = np.array([[1.0, 0.2], [0.0, 0.8], [0.1, 0.1]])
    influence = np.array([[1.0, 0.1, 0.4], [-0.2, 0.9, 0.3]])
    plant = slow_plant(2.25, shell(), modes=2, sensor_matrix=sensor, influence_matrix=influence)
    design = lbt.lqg(plant)
    assert design.certificate.passed
    assert design.controller.C.shape[0] == 3
    residual, _ = loop_variances(plant, design.controller)
    assert design.rms == pytest.approx(np.sqrt(residual), rel=1e-9)


def test_what_is_left_of_the_settled_mirror():
    """Against the difference of two series of positions, tap by tap."""
    plant = slow_plant(2.0, shell(), vibrations=None)
    design = lbt.lqg(plant)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    loop = lbt.close_loop(plant.hardware, design.controller)
    left = settling_error(loop, truth)
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
    assert abs(settling_error(loop, shake).line_amplitudes_nm[0, 0]) == pytest.approx(
        abs(change * command), rel=1e-9
    )


def test_a_settled_mirror_leaves_nothing():
    plant = slow_plant(2.25)
    loop = lbt.close_loop(plant.hardware, lbt.lqg(plant).controller)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    assert settling_error(loop, truth).rms_nm == 0


def test_the_other_designs_and_analyses_take_a_moving_mirror():
    plant = slow_plant(2.25, shell(300.0), modes=2)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    made = {
        "kalman": lbt.kalman(plant),
        "hinf": lbt.hinf(plant, gamma_ratio=1.3, route="riccati"),
        "integrator": lbt.design.optimal_integrator(plant.hardware, truth),
        "lqg": lbt.lqg(plant),
    }
    limit = lbt.loop.least_residual(plant.hardware, truth, frame_means=True).rms_nm
    for design in made.values():
        loop = lbt.close_loop(plant.hardware, design.controller)
        assert loop.is_stable
        left = lbt.residual_budget(loop, truth, frame_means=True)
        assert left.rms_nm >= limit * (1 - 1e-9)
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
    loops = (lbt.close_loop(path, each.controller) for each in (design, free))
    truth = lbt.Truth(turbulence=slow, noise_nm=20.0)
    left, least = (lbt.residual_budget(loop, truth).rms_nm for loop in loops)
    assert left >= least * (1 - 1e-9)
    with pytest.raises(lbt.errors.ProblemError, match="mirror that settles at once"):
        lbt.design.shape(
            path,
            lbt.design.shaping.Specification(
                objective=objective, demands=[lbt.design.shaping.LoopErrors(delay_frames=0.2)]
            ),
        )


def test_wrong_arguments_are_refused():
    plant = slow_plant(2.0, shell())
    with pytest.raises(lbt.errors.ProblemError, match="plant must be a TipTiltPlant"):
        lbt.lqg(lbt.LoopHardware(frame_rate_hz=800))
    with pytest.raises(lbt.errors.ProblemError, match="command_weight must be at least 0"):
        lbt.lqg(plant, command_weight=-1.0)
    flat = slow_plant(2.0, shell(), modes=2, influence_matrix=[[1.0], [0.5]])
    with pytest.raises(lbt.errors.DimensionError, match="must have rank 2"):
        lbt.lqg(flat)
    with pytest.raises(lbt.errors.ProblemError, match="plant must be a TipTiltPlant"):
        mirror_rows(plant.hardware, lbt.Truth(turbulence=None), lbt.Imaging(diameter_m=8))
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
                lbt.loop.least_residual(path, truth, frame_means=True)
    assert refused > 0


def test_other_disturbances_meet_the_same_loop():
    plant = slow_plant(2.25, shell())
    design = lbt.lqg(plant)
    moved = retuned_plant(plant, 2.0)
    assert astuple(moved.hardware.mirror) == astuple(plant.hardware.mirror)
    error = design.error_system(moved)
    from lbt_synth.linear.lyapunov import stationary_covariance

    X = stationary_covariance(error.A, error.B @ error.B.T)
    residual, _ = loop_variances(moved, design.controller)
    assert np.trace(error.C @ X @ error.C.T) == pytest.approx(residual, rel=1e-8)
    loop = lbt.close_loop(plant.hardware, design.controller)
    left = lbt.residual_budget(loop, moved).rms_nm
    assert left == pytest.approx(np.sqrt(residual), rel=0.05)  # a line is straight in the model
    with pytest.raises(lbt.errors.ProblemError, match="problem must be a TipTiltPlant"):
        design.error_system(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    with pytest.raises(lbt.errors.ProblemError, match="must have 5 states"):
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
