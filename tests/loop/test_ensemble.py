"""Many loops at once: against each loop on its own, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from support.ensembles import AIR, LINE, RATE, SLOW, plant, weather
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.loop import budget
from lbt_synth.loop.ensemble import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.evaluator import split_into_parts, textbook_matrices
from lbt_synth.models import ARModel, PositionLoop, SinusoidalVibration, SumSpectrum

CAMERA = lbt.Imaging(diameter_m=8.22, obstruction=0.11)


def ensemble_residuals(controller, hardware, ensemble, **facts):
    matrices = textbook_matrices([controller])
    return budget.ensemble_residuals(matrices, hardware, ensemble, **facts)


def ensemble_of(w, *, turbulence, direction=(1, 0.5)):
    return LoopEnsemble(
        sensor_gain=w["gains"],
        delay_frames=w["delays"],
        noise_nm=w["noise"],
        turbulence=turbulence,
        vibrations=[
            EnsembleVibration(frequency_hz=w["frequency"], rms_nm=w["rms"], direction=direction),
            EnsembleVibration(
                frequency_hz=w["frequency"] + 10,
                rms_nm=w["rms"],
                damping=w["damping"],
                direction=direction,
            ),
        ],
    )


def truth_of(w, i, turbulence, direction=(1, 0.5)):
    f, rms = float(w["frequency"][i]), float(w["rms"][i])
    return lbt.Truth(
        turbulence=turbulence,
        noise_nm=float(w["noise"][i]),
        sensor_gain=float(w["gains"][i]),
        vibrations=(
            SinusoidalVibration(frequency_hz=f, rms_nm=rms, direction=direction),
            lbt.Vibration(
                frequency_hz=f + 10, rms_nm=rms, damping=float(w["damping"][i]), direction=direction
            ),
        ),
    )


def agree(found, design, w, turbulence_of, *, rel=5e-7):
    """Hold each row against residual_budget of its own loop."""
    strehls = lbt.strehl(found, CAMERA)
    unstable = 0
    for i in range(len(found.stable)):
        hardware = replace(design.hardware, delay_frames=float(w["delays"][i]))
        truth = truth_of(w, i, turbulence_of(i))
        loop = lbt.close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
        assert found.stable[i] == loop.is_stable
        if not loop.is_stable:
            unstable += 1
            assert np.isnan([found.rms_nm[i], strehls[i], found.noise_nm[i]]).all()
            continue
        budget = lbt.residual_budget(loop, truth)
        for mine, theirs, apart in (
            (found.turbulence_nm2[i], budget.turbulence_nm2, rel),
            (found.noise_nm2[i], budget.noise_nm2, rel),
            # of a resonance, by quadrature where a hold is no frame
            (found.random_vibration_nm2[i], budget.random_vibration_nm2, 4 * rel),
            (found.within_nm2[i], budget.within_nm2, 4 * rel),
        ):
            assert np.max(np.abs(mine - theirs)) < apart * np.trace(theirs)
        left = np.abs(found.line_amplitudes_nm[i] - budget.line_amplitudes_nm)
        assert np.max(left) < 1e-9 * np.max(np.abs(budget.line_amplitudes_nm))
        assert found.rms_nm[i] == pytest.approx(budget.rms_nm, rel=rel)
        assert found.vibration_nm[i] == pytest.approx(budget.vibration_nm, rel=1e-9)
        assert strehls[i] == pytest.approx(lbt.strehl(budget, CAMERA), abs=1e-6)
    return unstable


@pytest.mark.parametrize("which", ["kalman", "coupled"])
def test_each_loop_on_its_own(which, request):
    """One process for all loops, one a loop, frozen flows, and different ones of the two axes."""
    design, w = request.getfixturevalue(which), weather(10, seed=1)
    flows = replace(AIR, seeing_arcsec=w["seeing"], wind_speed_m_s=w["wind"])

    def flow(i):
        return replace(AIR, seeing_arcsec=w["seeing"][i], wind_speed_m_s=w["wind"][i])

    rng = np.random.default_rng(2)
    poles, drive = rng.uniform(0.97, 0.995, 10), rng.uniform(20, 90, 10)
    each = ARModel(coefficients=poles[:, None], driving_rms_nm=drive, frame_rate_hz=RATE)

    def own(i):
        return ARModel(coefficients=[poles[i]], driving_rms_nm=drive[i], frame_rate_hz=RATE)

    for turbulence, single in (
        ((AIR, None), lambda i: (AIR, None)),
        (SLOW, lambda i: SLOW),
        (flows, flow),
        ((AIR, each), lambda i: (AIR, own(i))),
    ):
        ensemble = ensemble_of(w, turbulence=turbulence)
        found = ensemble_residuals(design.controller, design.hardware, ensemble)
        agree(found, design, w, single)
    w["gains"] = np.linspace(0.2, 4, 10)
    ensemble = ensemble_of(w, turbulence=SLOW)
    found = ensemble_residuals(design.controller, design.hardware, ensemble)
    assert agree(found, design, w, lambda i: SLOW) > 1


def test_a_bump_shakes_each_loop_as_it_shakes_one(kalman):
    bump = lbt.Vibration(frequency_hz=40, damping=0.2, rms_nm=100, sections=3)
    shaken = EnsembleVibration(frequency_hz=[40, 45], rms_nm=100, damping=0.2, sections=3)
    ensemble = LoopEnsemble(turbulence=SLOW, vibrations=(shaken,), noise_nm=10)
    left = ensemble_residuals(kalman.controller, kalman.hardware, ensemble).rms_nm
    loop = lbt.close_loop(kalman.hardware, kalman.controller)
    for frequency_hz, rms_nm in zip((40, 45), left, strict=True):
        line = replace(bump, frequency_hz=frequency_hz)
        truth = lbt.Truth(turbulence=SLOW, vibrations=(line,), noise_nm=10)
        assert rms_nm == pytest.approx(lbt.residual_budget(loop, truth).rms_nm, rel=1e-8)


def test_a_mirror_with_dynamics(kalman):
    shell = PositionLoop.from_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=300)
    design = lbt.kalman(plant(mirror=shell))
    w = weather(3, seed=4)
    w["gains"] = np.linspace(0.5, 1, 3)
    found = ensemble_residuals(design.controller, design.hardware, ensemble_of(w, turbulence=AIR))
    agree(found, design, w, lambda i: AIR)


@pytest.mark.parametrize(("delay", "distance"), [(2.3, 1e-7), (3.0, 1e-3), (4.7, 1e-5)])
def test_next_to_instability(delay, distance):
    """A process, whose residual is a Lyapunov equation's, as a spectrum."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    low, high = 0.0, 2.0
    for _ in range(50):
        middle = (low + high) / 2
        controller = lbt.Controller(A=1.0, B=middle, C=1.0, D=0.0, dt_s=1 / RATE)
        stable = lbt.close_loop(path, controller).is_stable
        low, high = (middle, high) if stable else (low, middle)
    controller = replace(controller, B=np.array([[low * (1 - distance)]]))
    loop = lbt.close_loop(path, controller)
    truths = lbt.Truth(turbulence=SLOW), lbt.Truth(turbulence=SumSpectrum(parts=[SLOW]))
    exact, single = (
        lbt.residual_budget(loop, truth, frame_means=True).turbulence_nm for truth in truths
    )
    assert single == pytest.approx(exact, rel=5e-7)
    ensemble = LoopEnsemble(turbulence=truths[1].turbulence)
    found = ensemble_residuals(controller, path, ensemble, frame_means=True)
    assert found.turbulence_nm[0] == pytest.approx(exact, rel=5e-7)
    found = ensemble_residuals(controller, path, LoopEnsemble(turbulence=SLOW))
    moving = lbt.residual_budget(loop, truths[0])
    assert found.rms_nm[0] == pytest.approx(moving.rms_nm, rel=5e-7)


def test_a_sinusoid_at_a_pole_of_the_controller_is_gone():
    """A resonator without damping, and an exposure that ends within a frame."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.3, modes=1)
    turn = [[0.0, -1.0], [1.0, 0.0]]
    entries = ([[0.05], [0.0]], [[0.0], [0.05]], [[-0.05], [0.0]], [[0.0], [-0.05]])
    resonators = [
        lbt.Controller(A=turn, B=B, C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE) for B in entries
    ]
    controller = next(one for one in resonators if lbt.close_loop(path, one).is_stable)
    line = EnsembleVibration(frequency_hz=[RATE / 4, RATE / 4 + 1], rms_nm=100.0, direction=(1.0,))
    ensemble = LoopEnsemble(sensor_gain=[0.9, 0.9], vibrations=[line])
    found = ensemble_residuals(controller, path, ensemble, frame_means=True)
    assert np.abs(found.line_amplitudes_nm)[0, 0, 0] < 1e-9
    # the commands turn by a quarter from frame to frame: the camera sees what lies between
    seen = ensemble_residuals(controller, path, ensemble)
    assert np.all(seen.rms_nm > 0.3 * 100)
    beside = SinusoidalVibration(frequency_hz=RATE / 4 + 1, rms_nm=100.0, direction=(1.0,))
    truth = lbt.Truth(turbulence=None, sensor_gain=0.9, vibrations=(beside,))
    loop = lbt.close_loop(path, controller, sensor_gain=0.9)
    assert seen.rms_nm[1] == pytest.approx(lbt.residual_budget(loop, truth).rms_nm, rel=1e-9)


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
    ensemble = LoopEnsemble(sensor_gain=[0.5, 1.0], noise_nm=15.5, turbulence=AIR)
    one, other = (ensemble_residuals(c, coupled.hardware, ensemble) for c in (k, odd))
    assert other.rms_nm == pytest.approx(one.rms_nm, rel=1e-8)


def test_a_state_that_no_mode_sees_counts_for_stability():
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    for pole, stable in ((0.5, True), (1.1, False)):
        hidden = lbt.Controller(
            A=np.diag([1.0, pole]), B=[[0.3], [0.0]], C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE
        )
        found = ensemble_residuals(hidden, path, LoopEnsemble(noise_nm=[1.0, 2.0]))
        assert found.stable.tolist() == [stable] * 2


def test_numbers_that_no_loop_has_are_refused(kalman):
    other = ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)
    fast = EnsembleVibration(frequency_hz=[20, 400], rms_nm=1)

    def met(**facts):
        return ensemble_residuals(kalman.controller, kalman.hardware, LoopEnsemble(**facts))

    rows = [
        (lambda: met(sensor_gain=0.0), ProblemError, "sensor_gain must be above 0"),
        (lambda: met(noise_nm=-1.0), ProblemError, "noise_nm must be at least 0"),
        (lambda: met(turbulence=other), ProblemError, "sampled at the loop's 800 Hz; got 500 Hz"),
        (lambda: met(vibrations=[fast]), ProblemError, "below the Nyquist"),
        (lambda: EnsembleVibration(frequency_hz=0.0, rms_nm=1), ProblemError, "above 0"),
    ]
    require_refusals(rows)
