"""Certified filters of several sensors, and claims that their certificates refuse."""

from dataclasses import replace

import numpy as np
import pytest
from lbt_synth.design.fusion import fused_filter
from lbt_synth.design.fusion.fused_filter import dwell_frames
from support.sensor_loops import FAST, LINES, SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.fallbacks import make_fallbacks
from lbt_synth.errors import CertificateError, InfeasibleError, LbtSynthError, ProblemError
from lbt_synth.linear import kalman_riccati
from lbt_synth.models import Accelerometer, WavefrontSensor


@pytest.fixture(scope="module")
def kalman():
    return lbt.kalman(example_plant((FAST, SLOW)))


@pytest.fixture(scope="module")
def hinf():
    return lbt.hinf(example_plant((SLOW,)), gamma_ratio=1.1)


def failed(design):
    """Return the names of the checks that a design fails."""
    return {check.name for check in design.recertify().checks if not check.passed}


def test_a_certified_filter(kalman):
    assert kalman.certificate.passed
    plant = kalman.problem
    P = lbt.linear.kalman_riccati(plant).P
    per_output = np.mean([np.diag(plant.L @ one @ plant.L.T) for one in P], axis=0)
    np.testing.assert_allclose(kalman.certificate.rms_per_output**2, per_output, rtol=1e-9)
    assert kalman.rms == pytest.approx(np.sqrt(per_output.sum()))
    assert kalman.gamma > kalman.rms / np.sqrt(2)
    assert kalman.method == "fused kalman"
    assert len(kalman.fallbacks) == 15
    assert np.abs(kalman.poles).max() < 1


def test_each_sensor_helps(kalman):
    alone = lbt.kalman(kalman.problem.own).rms
    two = lbt.kalman(example_plant((FAST,))).rms
    assert kalman.rms < two < alone


def test_gains_that_are_not_the_least(kalman):
    worse = replace(kalman, gains=1.001 * kalman.gains)
    assert failed(worse) == {"distance from the least-variance gains"}
    assert "spectral radius over a period" in failed(replace(kalman, gains=3 * kalman.gains))


def test_a_fallback_that_is_not_the_least(kalman):
    first, *others = kalman.fallbacks
    for gains in (1.001 * first.gains, kalman.gains):
        design = replace(kalman, fallbacks=(replace(first, gains=gains), *others))
        assert failed(design) == {"distance from the least-variance gains of any fall-back"}
    last = replace(kalman.fallbacks[-1], gains=1e-3 * kalman.gains)
    assert failed(replace(kalman, fallbacks=(*kalman.fallbacks[:-1], last)))


def test_a_fallback_that_diverges(kalman):
    first, *others = kalman.fallbacks
    design = replace(kalman, fallbacks=(replace(first, gains=20 * first.gains), *others))
    assert failed(design) >= {"spectral radius of any loop with sensors missing"}


def test_an_hinf_filter(hinf):
    assert hinf.certificate.passed
    assert hinf.gamma_requested == pytest.approx(1.1 * hinf.gamma_least)
    assert hinf.gamma_least < hinf.gamma < hinf.gamma_requested
    kalman = lbt.kalman(hinf.problem)
    assert kalman.rms < hinf.rms
    assert hinf.gamma < kalman.gamma
    assert lbt.hinf(hinf.problem, gamma=hinf.gamma_requested).gains == pytest.approx(hinf.gains)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_least_gamma_that_is_wrong(hinf, factor):
    design = replace(hinf, gamma_least=factor * hinf.gamma_least)
    proof = "infeasible level over the level proved, less 1"  # the worst of that level
    assert failed(design) == {"least norm of any filter, error", proof}


def test_a_level_that_filters_reach(hinf):
    assert hinf.gamma_infeasible == pytest.approx(hinf.gamma_least, rel=1e-6)
    design = replace(hinf, gamma_infeasible=1.001 * hinf.gamma_least)
    assert failed(design) == {"infeasible level over the level proved, less 1"}
    assert failed(replace(hinf, gamma_infeasible=0.9 * hinf.gamma_least)) == set()


def test_a_bound_that_is_not_met(hinf):
    found = failed(replace(hinf, gamma_requested=0.99 * hinf.gamma))
    norm = "norm of the estimation error over its bound, less 1"
    assert found == {norm, "distance from its Riccati filter"}
    kalman = lbt.linear.kalman_riccati(hinf.problem).gain_predictor
    assert "distance from its Riccati filter" in failed(replace(hinf, gains=kalman))


def test_a_design_that_fails_is_not_returned(monkeypatch):

    solve = fused_filter.kalman_riccati
    monkeypatch.setattr(
        fused_filter,
        "kalman_riccati",
        lambda plant: replace(solve(plant), gain_predictor=1.01 * solve(plant).gain_predictor),
    )
    with pytest.raises(CertificateError, match="failed its certificate"):
        lbt.kalman(example_plant((SLOW,)))


def test_the_loop_of_one_rate_is_that_of_the_filter():
    fast = WavefrontSensor(name="other", rate_hz=1000, delay_frames=2, noise_nm=1e7)
    design = lbt.kalman(example_plant((fast,)))
    alone = lbt.kalman(design.problem.own)
    hardware = design.loop_hardware
    loop = lbt.close_loop(hardware, alone)
    assert design.rms == pytest.approx(alone.rms, rel=1e-6)
    facts = design.facts()
    assert facts.loop_radius == pytest.approx(loop.spectral_radius, rel=1e-6)
    gains = lbt.loop.stable_sensor_gains(hardware, alone)
    assert (facts.gain_low, facts.gain_high) == pytest.approx(gains, rel=1e-3, abs=2e-3)
    assert design.close(hardware, sensor_gain=0.5).sensor_gain == 0.5


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: lbt.kalman(example_plant().own), ProblemError, "plant must be a"),
        (lambda: lbt.hinf(example_plant().own), ProblemError, "plant must be a"),
        (lambda: lbt.hinf(example_plant((SLOW,)), gamma=1.0), InfeasibleError, "least"),
        (lambda: lbt.hinf(example_plant((SLOW,)), gamma_ratio=0.5), LbtSynthError, "gamma_ratio"),
        (
            lambda: lbt.kalman(
                example_plant(
                    (
                        Accelerometer(
                            name="many",
                            rate_hz=1000,
                            delay_frames=2,
                            channels=tuple("abcdef"),
                            noise_m_s2=1e-3,
                        ),
                    ),
                    motions=({}, {}),
                )
            ),
            ProblemError,
            "there may be 6; got 7",
        ),
    ],
)
def test_refusals(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize("ratio", [1.02, 1.1])
def test_it_lies_between_the_two(fused_config, fused, ratio):
    plant = fused_config.plant
    central = lbt.hinf(plant, gamma_ratio=ratio)
    mixed = lbt.mixed(plant, gamma_ratio=ratio)
    assert fused.rms < mixed.rms < central.rms
    assert central.gamma < mixed.gamma <= mixed.gamma_requested * (1 + 1e-9)
    assert mixed.gamma == pytest.approx(mixed.gamma_requested, rel=1e-5)


def test_a_bound_that_the_kalman_filter_meets(fused_config, fused):
    found = lbt.mixed(fused_config.plant, gamma=1.01 * fused.gamma)
    assert found.method == "fused kalman"
    assert found.rms == pytest.approx(fused.rms, rel=1e-12)


def test_a_bound_below_the_least(fused_config):
    with pytest.raises(InfeasibleError, match="gamma must be at least"):
        lbt.mixed(fused_config.plant, gamma=1.0)


def test_a_configuration_and_its_gain_file(fused_config, tmp_path):
    design = fused_config.design("mixed", gamma_ratio=1.05)
    again = lbt.load_gain(lbt.save_gain(tmp_path / "mixed.npz", design))
    assert (again.method, again.gamma_central) == ("fused mixed", design.gamma_central)
    with pytest.raises(ProblemError, match="rms must be left out with several sensors"):
        fused_config.design("mixed", rms=50.0)


SHARP = tuple(replace(line, damping=0.005) for line in LINES)
CALM = lbt.models.ARModel(coefficients=[1.9975, -0.99755], driving_rms_nm=2, frame_rate_hz=1000)
EARLY = replace(SLOW, delay_frames=1.25)  # its sums are empty when a period begins


def growth_per_frame(plant, turns):
    """Return what a cycle of turns (gains, frames) makes of the error, per frame."""
    errors = [(plant.error_system(gains).stacks()[0], frames) for gains, frames in turns]
    cycle, phase, total = np.eye(plant.n_states), 0, 0
    for _ in range(plant.period):  # the cycle may end in the midst of a period
        for A, frames in errors:
            for _ in range(frames):
                cycle = A[phase] @ cycle
                phase = (phase + 1) % plant.period
            total += frames
    return np.max(np.abs(np.linalg.eigvals(cycle))) ** (1 / total)


def designed(plant):
    return kalman_riccati(plant).gain_predictor, make_fallbacks(plant)


def test_stable_filters_that_take_turns_may_diverge():
    plant = example_plant((FAST,), lines=SHARP, turbulence=CALM, noise_nm=15)
    gains, fallbacks = designed(plant)
    without = next(each.gains for each in fallbacks if each.missing == ("wavefront",))
    for own in (gains, without):
        assert growth_per_frame(plant, [(own, 1)]) < 1
    assert growth_per_frame(plant, [(gains, 3), (without, 30)]) > 1.04
    frames = dwell_frames(plant, gains, fallbacks)
    assert frames > 30
    assert growth_per_frame(plant, [(gains, frames), (without, frames)]) < 1


@pytest.mark.parametrize("sensors", [(FAST,), (FAST, SLOW), (EARLY,)])
def test_filters_that_stay_do_not_diverge(sensors):
    plant, rng = example_plant(sensors), np.random.default_rng(0)
    gains, fallbacks = designed(plant)
    frames = dwell_frames(plant, gains, fallbacks)
    assert 1 < frames < 300
    filters = [gains, *(each.gains for each in fallbacks)]
    for _ in range(5):
        order = rng.permutation(len(filters))
        turns = [(filters[i], frames + int(rng.integers(plant.period))) for i in order]
        assert growth_per_frame(plant, turns) < 1


def test_a_single_filter_is_its_own_proof():
    plant = example_plant((FAST,))
    gains = kalman_riccati(plant).gain_predictor
    assert dwell_frames(plant, gains, ()) < 100


def test_what_is_not_proved(monkeypatch):
    plant = example_plant((FAST,))
    monkeypatch.setattr(fused_filter, "LONGEST_DWELL", 10)
    assert dwell_frames(plant, *designed(plant)) is None
