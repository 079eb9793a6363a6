"""Many loops at once: against each loop on its own, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.ensembles import AIR, LINE, RATE, SLOW, plant, weather
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import budget
from lbt_synth.loop.ensemble import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.evaluator import split_into_parts, textbook_matrices
from lbt_synth.models import ARModel, PositionLoop, SinusoidalVibration, SumSpectrum

CAMERA = lbt.Imaging(diameter_m=8.22, obstruction=0.11)


SHELL = PositionLoop.from_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=300)
TURN = 0.9 * np.array([[np.cos(np.pi / 6), -0.5], [0.5, np.cos(np.pi / 6)]])
ASKEW = [replace(LINE, direction=(1, 2)), replace(LINE, frequency_hz=31, direction=(1, 0))]
PLANTS = {
    "kalman": {},
    "coupled": {"sensor_matrix": TURN, "vibrations": ASKEW},  # no axis is independent
    "uneven": {"vibrations": [LINE]},
    "mirror": {"mirror": SHELL},
}


@cache
def designed(name):
    return lbt.kalman(plant(**PLANTS[name]))


def ensemble_residuals(design, ensemble, hardware=None, **facts):
    matrices = textbook_matrices([as_controller(design)])
    return budget.ensemble_residuals(matrices, hardware or design.hardware, ensemble, **facts)


def ensemble_of(w, turbulence):
    """Return loops that meet a line of known frequency, a resonance and a bump."""
    f, facts = w["frequency"], {"rms_nm": w["rms"], "direction": (1, 0.5)}
    lines = (
        EnsembleVibration(frequency_hz=f, **facts),
        EnsembleVibration(frequency_hz=f + 10, damping=w["damping"], **facts),
        EnsembleVibration(frequency_hz=f + 20, damping=0.2, sections=3, **facts),
    )
    facts = {"sensor_gain": w["gains"], "delay_frames": w["delays"], "noise_nm": w["noise"]}
    return LoopEnsemble(**facts, turbulence=turbulence, vibrations=lines)


def truth_of(w, i, turbulence):
    one = {name: float(numbers[i]) for name, numbers in w.items()}
    f, facts = one["frequency"], {"rms_nm": one["rms"], "direction": (1, 0.5)}
    lines = (
        SinusoidalVibration(frequency_hz=f, **facts),
        lbt.Vibration(frequency_hz=f + 10, damping=one["damping"], **facts),
        lbt.Vibration(frequency_hz=f + 20, damping=0.2, sections=3, **facts),
    )
    facts = {"noise_nm": one["noise"], "sensor_gain": one["gains"]}
    return lbt.Truth(turbulence=turbulence, vibrations=lines, **facts)


def agree(design, w, turbulence, turbulence_of, *, rel=5e-7):
    """Hold each loop against residual_budget of its own; return how many are unstable."""
    many = ensemble_residuals(design, ensemble_of(w, turbulence))
    strehls = lbt.strehl(many, CAMERA)
    # of a resonance, by quadrature where a hold is no frame
    accuracies = {"turbulence_nm2": rel, "noise_nm2": rel, "random_vibration_nm2": 4 * rel}
    for i in range(len(many.stable)):
        hardware = replace(design.hardware, delay_frames=float(w["delays"][i]))
        truth = truth_of(w, i, turbulence_of(i))
        loop = lbt.close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
        assert many.stable[i] == loop.is_stable
        if not loop.is_stable:
            assert np.isnan([many.rms_nm[i], strehls[i], many.noise_nm[i]]).all()
            continue
        one = lbt.residual_budget(loop, truth)
        for name, apart in (accuracies | {"within_nm2": 4 * rel}).items():
            mine, theirs = getattr(many, name)[i], getattr(one, name)
            assert np.max(np.abs(mine - theirs)) < apart * np.trace(theirs)
        left = np.abs(many.line_amplitudes_nm[i] - one.line_amplitudes_nm)
        assert np.max(left) < 1e-9 * np.max(np.abs(one.line_amplitudes_nm))
        assert many.rms_nm[i] == pytest.approx(one.rms_nm, rel=rel)
        assert many.vibration_nm[i] == pytest.approx(one.vibration_nm, rel=1e-8)
        assert strehls[i] == pytest.approx(lbt.strehl(one, CAMERA), abs=1e-6)
    return np.count_nonzero(~many.stable)


@pytest.mark.parametrize("name", ["kalman", "coupled"])
def test_each_loop_on_its_own(name):
    """One process for all loops, one a loop, frozen flows, and different ones of the two axes."""
    design, w, rng = designed(name), weather(10, seed=1), np.random.default_rng(2)
    winds = {"seeing_arcsec": w["seeing"], "wind_speed_m_s": w["wind"]}
    poles, drive = rng.uniform(0.97, 0.995, 10), rng.uniform(20, 90, 10)

    def flow(i):
        return replace(AIR, **{name: numbers[i] for name, numbers in winds.items()})

    def process(i):
        return ARModel(coefficients=poles[i, None], driving_rms_nm=drive[i], frame_rate_hz=RATE)

    processes = ARModel(coefficients=poles[:, None], driving_rms_nm=drive, frame_rate_hz=RATE)
    for turbulence, turbulence_of in (
        ((AIR, None), lambda i: (AIR, None)),
        (SLOW, lambda i: SLOW),
        (replace(AIR, **winds), flow),
        ((AIR, processes), lambda i: (AIR, process(i))),
    ):
        agree(design, w, turbulence, turbulence_of)
    strong = w | {"gains": np.linspace(0.2, 4, 10)}
    assert agree(design, strong, SLOW, lambda i: SLOW) > 1


def test_a_mirror_with_dynamics():
    w = weather(3, seed=4) | {"gains": np.linspace(0.5, 1, 3)}
    assert not agree(designed("mirror"), w, AIR, lambda i: AIR)


@pytest.mark.parametrize(("delay", "distance"), [(2.3, 1e-7), (3.0, 1e-3), (4.7, 1e-5)])
def test_next_to_instability(delay, distance):
    """A process, whose residual is a Lyapunov equation's, as a spectrum."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    gain = lbt.design.integrator_gain_limit(path) * (1 - distance)
    controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1 / RATE)
    loop, spectrum = lbt.close_loop(path, controller), SumSpectrum(parts=[SLOW])
    exact, single = (
        lbt.residual_budget(loop, lbt.Truth(turbulence=air), frame_means=True).turbulence_nm
        for air in (SLOW, spectrum)
    )
    ensemble = LoopEnsemble(turbulence=spectrum)
    many = ensemble_residuals(controller, ensemble, path, frame_means=True).turbulence_nm[0]
    assert (single, many) == pytest.approx((exact, exact), rel=5e-7)
    moving = lbt.residual_budget(loop, lbt.Truth(turbulence=SLOW)).rms_nm
    many = ensemble_residuals(controller, LoopEnsemble(turbulence=SLOW), path).rms_nm
    assert many[0] == pytest.approx(moving, rel=5e-7)


def test_a_sinusoid_at_a_pole_of_the_controller_is_gone():
    """A resonator without damping, and an exposure that ends within a frame."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.3, modes=1)
    parts = {"A": [[0.0, -1.0], [1.0, 0.0]], "B": [[-0.05], [0.0]], "C": [[1.0, 0.0]], "D": 0.0}
    controller = lbt.Controller(**parts, dt_s=1 / RATE)
    line = EnsembleVibration(frequency_hz=[RATE / 4, RATE / 4 + 1], rms_nm=100.0, direction=(1.0,))
    ensemble = LoopEnsemble(sensor_gain=[0.9, 0.9], vibrations=[line])
    means = ensemble_residuals(controller, ensemble, path, frame_means=True)
    assert np.abs(means.line_amplitudes_nm)[0, 0, 0] < 1e-9
    # the commands turn by a quarter from frame to frame: the camera sees what lies between
    seen = ensemble_residuals(controller, ensemble, path)
    assert np.all(seen.rms_nm > 0.3 * 100)
    beside = SinusoidalVibration(frequency_hz=RATE / 4 + 1, rms_nm=100.0, direction=(1.0,))
    truth = lbt.Truth(turbulence=None, sensor_gain=0.9, vibrations=(beside,))
    loop = lbt.close_loop(path, controller, sensor_gain=0.9)
    assert seen.rms_nm[1] == pytest.approx(lbt.residual_budget(loop, truth).rms_nm, rel=1e-9)


def test_a_loop_is_split_into_parts():
    # an axis without a vibration is another part than one with
    expected = {"kalman": [[[0], [1]]], "coupled": [[[0, 1]]], "uneven": [[[0]], [[1]]]}
    for name, modes in expected.items():
        matrices = textbook_matrices([designed(name).controller])
        parts, rest = split_into_parts(matrices, designed(name).hardware)
        assert ([own.tolist() for own, *_ in parts], rest) == (modes, [])


@pytest.mark.parametrize("name", ["kalman", "coupled", "uneven"])
def test_equal_lines_on_both_axes_leave_what_each_leaves_alone(name):
    facts = {"frequency_hz": 21.0, "damping": 0.01, "rms_nm": 50.0}
    lines = [EnsembleVibration(**facts, direction=along) for along in ((1, 0), (0, 1))]
    both, *alone = (
        ensemble_residuals(designed(name), LoopEnsemble(sensor_gain=[0.8, 1], vibrations=some))
        for some in (lines, lines[:1], lines[1:])
    )
    expected = sum(one.random_vibration_nm2 for one in alone)
    np.testing.assert_allclose(both.random_vibration_nm2, expected, rtol=1e-9, atol=1e-9)


def test_states_in_odd_units_stay_coupled():
    """The same controller in states of 1e9 times other units is the same controller."""
    path, k = designed("coupled").hardware, designed("coupled").controller
    units = 10.0 ** np.linspace(-9, 9, k.n_states)
    A, B, C = k.A * units / units[:, None], k.B / units[:, None], k.C * units
    ensemble = LoopEnsemble(sensor_gain=[0.5, 1.0], noise_nm=15.5, turbulence=AIR)
    odd = lbt.Controller(A=A, B=B, C=C, D=k.D, dt_s=k.dt_s)
    one, other = (ensemble_residuals(c, ensemble, path).rms_nm for c in (k, odd))
    assert other == pytest.approx(one, rel=1e-8)


def test_a_state_that_no_mode_sees_counts_for_stability():
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    for pole, stable in ((0.5, True), (1.1, False)):
        parts = {"A": np.diag([1.0, pole]), "B": [[0.3], [0.0]], "C": [[1.0, 0.0]], "D": 0.0}
        hidden = lbt.Controller(**parts, dt_s=1 / RATE)
        many = ensemble_residuals(hidden, LoopEnsemble(noise_nm=[1.0, 2.0]), path)
        assert many.stable.tolist() == [stable] * 2


def test_numbers_that_no_loop_has_are_refused():
    other = ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)
    fast = EnsembleVibration(frequency_hz=[20, 400], rms_nm=1)

    def met(**facts):
        return lambda: ensemble_residuals(designed("kalman"), LoopEnsemble(**facts))

    rows = [
        (met(sensor_gain=0.0), ProblemError, "sensor_gain must be above 0"),
        (met(noise_nm=-1.0), ProblemError, "noise_nm must be at least 0"),
        (met(turbulence=other), ProblemError, "sampled at the loop's 800 Hz; got 500 Hz"),
        (met(vibrations=[fast]), ProblemError, "below the Nyquist"),
        (lambda: EnsembleVibration(frequency_hz=0.0, rms_nm=1), ProblemError, "above 0"),
    ]
    require_refusals(rows)
