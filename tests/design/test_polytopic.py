"""Filters for an interval of vibration frequencies."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from support.intervals import IntervalDesigns, predictor
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.worst_case import error_size, search_worst_error

RATE = 800


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def made():
    return IntervalDesigns()


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_bound_and_worst_error_are_close(made, norm):
    design = made[norm, 1.0]
    assert design.method == f"polytopic-{norm}"
    assert design.certificate.passed
    assert design.worst_achieved <= design.bound_guaranteed <= 1.0001 * design.worst_achieved
    # the programme's own bound is a bound as well, and close
    assert design.bound_guaranteed <= design.bound_programme <= 1.03 * design.worst_achieved
    assert design.predictor.n_states == 4
    assert design.controller.n_states == 4 + 1
    assert max(abs(design.poles)) < 1


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_nowhere_on_the_interval_is_it_worse(made, norm):
    design = made[norm, 1.0]
    for f in np.random.default_rng(5).uniform(19, 21, 200):
        a1 = design.interval.coefficient(float(f))
        size = error_size(design.interval.error_system(a1, design.predictor), norm)
        assert size <= design.bound_guaranteed * (1 + 1e-9)


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_a_wider_interval_has_a_larger_bound(made, norm):
    bounds = [made[norm, half].bound_guaranteed for half in (0.0, 0.2, 1.0, 2.0)]
    assert all(after > 1.001 * before for before, after in itertools.pairwise(bounds))


def test_no_interval_is_the_nominal_design(plant, made):
    least, kalman = lbt.hinf(plant, route="riccati"), lbt.kalman(plant)
    assert made["hinf", 0.0].bound_guaranteed == pytest.approx(least.gamma_least, rel=1e-6)
    assert made["h2", 0.0].bound_guaranteed == pytest.approx(kalman.rms, rel=1e-6)
    assert made["h2", 0.0].gamma == pytest.approx(kalman.gamma, rel=1e-2)


def test_it_beats_the_nominal_filters_on_the_interval(plant, made):
    nominal = {
        "hinf": lbt.hinf(plant, route="riccati"),
        "h2": lbt.kalman(plant),
    }
    for norm, factor in (("hinf", 3.0), ("h2", 1.01)):
        interval = made[norm, 1.0].interval
        worst, _ = search_worst_error(interval, predictor(nominal[norm]), norm)
        assert worst > factor * made[norm, 1.0].bound_guaranteed


def test_the_plant_at_an_end_in_the_loop(made):
    """The residual of the closed loop is the estimation error, at the centre and at an end."""
    design = made["h2", 1.0]
    loop = lbt.close_loop(design.hardware, design.controller)
    for f in (20.0, 19.0):
        line = design.problem.vibrations[0]
        drive = line.ar_model(RATE).driving_rms_nm
        moved = line.at_frequency(f)
        moved = dataclasses.replace(
            moved, rms_nm=moved.rms_nm * drive / moved.ar_model(RATE).driving_rms_nm
        )
        truth = lbt.Truth(
            turbulence=design.problem.turbulence[0], vibrations=(moved,), noise_nm=15.5
        )
        a1 = design.interval.coefficient(f)
        size = error_size(design.interval.error_system(a1, design.predictor), "h2")
        assert lbt.residual_budget(loop, truth).rms_nm == pytest.approx(size, rel=1e-8)


def test_two_axes(made):
    decoupled = lbt.design.polytopic(lbt_axis_plant(modes=2), half_width_hz=1.0)
    assert decoupled.bound_guaranteed == pytest.approx(made["hinf", 1.0].bound_guaranteed, rel=1e-4)
    variance = lbt.design.polytopic(lbt_axis_plant(modes=2), half_width_hz=1.0, norm="h2")
    expected = np.sqrt(2) * made["h2", 1.0].bound_guaranteed
    assert variance.bound_guaranteed == pytest.approx(expected, rel=1e-4)


def test_coupled_axes_and_an_axis_without_vibration(made):
    slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    across = dataclasses.replace(line, direction=(1.0, 1.0))
    common = {"frame_rate_hz": RATE, "turbulence": slow, "noise_nm": 15.5}
    alone = lbt.design.polytopic(lbt.tip_tilt_plant(vibrations=[line], **common), half_width_hz=1.0)
    turned = lbt.design.polytopic(
        lbt.tip_tilt_plant(vibrations=[across], **common), half_width_hz=1.0
    )
    # the same plant in turned axes
    assert turned.bound_guaranteed == pytest.approx(alone.bound_guaranteed, rel=1e-3)
    assert alone.bound_guaranteed == pytest.approx(made["hinf", 1.0].bound_guaranteed, rel=1e-2)


def test_states_that_are_sums_of_others(plant):
    """With AR2 turbulence and two frames the past total is the sum of two other states."""
    turbulence = lbt.models.ARModel(
        coefficients=[1.9, -0.905], driving_rms_nm=5, frame_rate_hz=RATE
    )
    redundant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=turbulence,
        vibrations=plant.vibrations,
        noise_nm=15.5,
        modes=1,
    )
    design = lbt.design.polytopic(redundant, half_width_hz=1.0)
    assert (redundant.n_states, design.predictor.n_states) == (5, 4)
    assert design.bound_guaranteed < 1.02 * design.worst_achieved


def test_another_horizon_is_another_delay(plant):
    design = lbt.design.polytopic(plant, half_width_hz=0.5, horizon=2)
    assert design.hardware.delay_frames == 3
    assert design.bound_guaranteed > lbt.hinf(plant, horizon=2, route="riccati").gamma_least


def test_wrong_arguments_are_refused(plant):
    lines = [plant.vibrations[0], plant.vibrations[0].retuned(30, frame_rate_hz=RATE)]
    common = {
        "frame_rate_hz": RATE,
        "turbulence": plant.turbulence[0],
        "noise_nm": 15.5,
        "modes": 1,
    }
    two, none = lbt.tip_tilt_plant(vibrations=lines, **common), lbt.tip_tilt_plant(**common)
    for wrong, arguments, text in (
        (two, {}, "one uncertain frequency at a time.*20 Hz with 0.01 and 30 Hz"),
        (none, {}, "needs a vibration; got a plant without any"),
        (plant.full(), {}, "needs a TipTiltPlant; got FullStatePlant"),
        (lbt.mixed(plant, gamma_ratio=1.1, taps=2).problem, {}, "holds the memory"),
        (plant, {"norm": "h1"}, "norm must be one of hinf, h2; got 'h1'"),
        (plant, {"half_width_hz": -1}, "half_width_hz must be at least 0"),
        (plant, {"half_width_hz": np.nan}, "half_width_hz must be finite"),
        (plant, {"half_width_hz": 20.0}, "decays at 0.2 Hz .* got 0 Hz"),
        (plant, {"half_width_hz": 381.0}, "got -361 Hz"),
        (plant, {"horizon": 0.5}, "horizon must be an integer"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=text):
            lbt.design.polytopic(wrong, **{"half_width_hz": 1.0, **arguments})
    high = lbt.tip_tilt_plant(
        vibrations=[lbt.Vibration(frequency_hz=395, damping=0.01, rms_nm=9, direction=(1,))],
        **common,
    )
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 401 Hz"
    ):
        lbt.design.polytopic(high, half_width_hz=6)


def test_a_solver_that_fails_or_lies_is_not_believed(plant, monkeypatch):
    from lbt_synth.linear.lmi import polytopic as programmes

    monkeypatch.setattr(programmes, "solve", lambda *_: ("infeasible", 3))
    with pytest.raises(lbt.errors.NumericalError, match="ended as 'infeasible'.*narrower"):
        lbt.design.polytopic(plant, half_width_hz=1.0)
    unstable = programmes.SegmentFilter(
        A=1.01 * np.eye(4),
        B=np.ones((4, 1)),
        C=np.ones((1, 4)),
        bound=1.0,
        status="optimal",
        iterations=1,
    )
    monkeypatch.setattr("lbt_synth.linear.lmi.polytopic.segment_filter", lambda *_, **__: unstable)
    with pytest.raises(lbt.errors.CertificateError, match="spectral radius of plant and filter"):
        lbt.design.polytopic(plant, half_width_hz=1.0)


def test_claims_that_do_not_hold(made):
    design = made["hinf", 1.0]
    for change, failed in (
        (
            {"bound_guaranteed": 0.99 * design.bound_guaranteed},
            "bound recomputed over the one stated",
        ),
        ({"worst_achieved": 0.9 * design.worst_achieved}, "worst error found over the one stated"),
        ({"worst_frequency_hz": 20.3}, "worst error stated, against that at its frequency"),
        ({"half_width_hz": 1.1}, "bound recomputed over the one stated"),
        ({"half_width_hz": 0.9}, "distance of that frequency"),
        ({"predictor": made["h2", 1.0].predictor}, "bound recomputed over the one stated"),
    ):
        names = [
            c.name for c in dataclasses.replace(design, **change).recertify().checks if not c.passed
        ]
        assert any(name.startswith(failed) for name in names), (change, names)


@pytest.mark.study
@pytest.mark.parametrize("norm", ["hinf", "h2"])
@pytest.mark.parametrize("damping", [0.001, 0.0051, 0.05, 0.3])
@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 3.0, 4.0])
def test_other_dampings_and_delays(norm, damping, delay):
    for half in (0.1, 1.0, 3.0):
        plant = lbt_axis_plant(damping=damping, delay_frames=delay)
        design = lbt.design.polytopic(plant, half_width_hz=half, norm=norm)
        assert design.bound_guaranteed <= 1.0001 * design.worst_achieved
        # the programme itself is less tight where the interval is many times the line's width
        assert design.bound_programme <= (1.06 if damping > 0.001 else 1.15) * design.worst_achieved
