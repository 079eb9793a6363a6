"""Convex shaping: its parts against the real loop, its designs against closed forms and oracles."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.design.shaping.basis import laguerre_basis, orthonormal_basis
from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.pole_fitting import fit_poles
from lbt_synth.design.shaping.programme_sequence import solve_sequence
from lbt_synth.design.shaping.single_mode_loop import mode_loop
from lbt_synth.files.gain_file.store import _digest
from lbt_synth.linear.norms import band_norm, largest_real_part

RATE = 800.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=RATE)
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
ONE = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
NOISE = 20.0
OTHER_RATE = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=100)
BASIC = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=NOISE)


def channel(size=12, pole=0.6, delay=2.0):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    return Channel(hardware=path, basis=laguerre_basis(size, pole, dt_s=1 / RATE))


def spec(*demands, objective=BASIC):
    return lbt.design.shaping.Specification(objective=objective, demands=demands)


def random_coefficients(size, seed=0):
    return np.random.default_rng(seed).normal(size=size) * 0.3


# -- bases ---------------------------------------------------------------------------------
@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-0.95, 0.99), max_size=4),
    st.lists(st.tuples(st.floats(0.05, 0.999), st.floats(0.01, 3.1)), min_size=1, max_size=5),
)
def test_a_basis_is_orthonormal_and_has_its_poles(real, pairs):
    upper = np.array([r * np.exp(1j * a) for r, a in pairs])
    poles = np.concatenate([upper, upper.conj(), np.array(real, dtype=complex)])
    basis = orthonormal_basis(poles, dt_s=1.0)
    np.testing.assert_allclose(
        basis.A @ basis.A.T + basis.B @ basis.B.T, np.eye(len(poles)), atol=1e-9
    )
    # the characteristic polynomial: the poles themselves are ill-conditioned where they repeat
    np.testing.assert_allclose(np.poly(basis.A), np.poly(poles).real, atol=1e-8)


def test_taps_and_laguerre_functions_are_special_cases():
    f = np.array([0.0, 3.0, 77.0, 400.0])
    z = np.exp(2j * np.pi * f / RATE)[:, None]
    taps = laguerre_basis(5, 0.0, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(taps), 1, atol=1e-12)
    np.testing.assert_allclose(taps**2, (z ** -np.arange(5)) ** 2, atol=1e-12)  # but for signs
    a, k = 0.6, np.arange(5)
    expected = np.sqrt(1 - a * a) * z / (z - a) * ((1 - a * z) / (z - a)) ** k
    found = laguerre_basis(5, a, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-12)


@pytest.mark.parametrize(
    ("poles", "message"), [([1.0], "inside the unit circle"), ([0.5 + 0.1j], "conjugate pairs")]
)
def test_a_basis_refuses_poles_that_are_none(poles, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        orthonormal_basis(np.array(poles, dtype=complex), dt_s=1.0)


# -- peaks over frequency --------------------------------------------------------------------
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_peaks_of_a_band_and_of_the_real_part_against_a_dense_grid(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.99) / np.max(np.abs(np.linalg.eigvals(A)))
    system = lbt.linear.StateSpace(
        A=A, B=rng.normal(size=(n, 1)), C=rng.normal(size=(1, n)), D=rng.normal(size=(1, 1))
    )
    low, high = np.sort(rng.uniform(0, 0.5, 2))
    f = np.linspace(0, 0.5, 20001)
    response = system.frequency_response(f)[:, 0, 0]
    largest = largest_real_part(system)
    size = np.max(np.abs(response))
    assert largest >= np.max(response.real) - 1e-9 * size
    assert largest <= np.max(response.real) + 1e-3 * size
    inside = np.linspace(low, high, 4001)
    dense = np.max(np.abs(system.frequency_response(inside)))
    found = band_norm(system, low, high)
    assert dense * (1 - 1e-10) <= found.upper <= dense * 1.001
    assert low <= found.peak_frequency_hz <= high


# -- terms and demands against the real loop ---------------------------------------------------
TERMS = [
    BASIC,
    replace(BASIC, sensor_gain=0.5),
    lbt.design.shaping.ResidualVariance(turbulence=AIR, noise_nm=15.5, sensor_gain=1.2),
    lbt.design.shaping.ResidualVariance(turbulence=None, noise_nm=15.5),
    lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797),
    lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797, sensor_gain=0.6),
    lbt.design.shaping.Total(
        terms=(BASIC, lbt.design.shaping.VibrationBand(low_hz=5, high_hz=9, rms_nm=30)),
        weights=(1, 2),
    ),
    lbt.design.shaping.Worst(
        terms=(BASIC, lbt.design.shaping.VibrationBand(low_hz=5, high_hz=9, rms_nm=30)),
        weights=(0.1, 2),
    ),
]


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("term", TERMS, ids=lambda t: getattr(t, "label", type(t).__name__))
def test_a_term_over_the_grid_is_the_residual_of_the_real_loop(term, delay):
    mode = channel(delay=delay)
    c = random_coefficients(12) * 0.5
    found = term.function(mode, spec(objective=term).grid(mode, fineness=2)).value(c)
    exact = term.measured_nm2(mode_loop(mode.hardware, mode.basis.parameter(c)))
    assert found == pytest.approx(exact, rel=2e-3)


@pytest.mark.parametrize(
    "demand",
    [
        lbt.design.shaping.ModulusMargin(at_least=0.4),
        lbt.design.shaping.NoisePeak(at_most=2),
        lbt.design.shaping.Attenuation(low_hz=3, high_hz=9, at_most=0.7),
        lbt.design.shaping.Attenuation(low_hz=3, high_hz=9, at_most=1.4, sensor_gain=0.5),
        lbt.design.shaping.SensorGainRange(low=0.4, high=1.0),
        lbt.design.shaping.SensorGainRange(low=1.0, high=1.5),
        lbt.design.shaping.MirrorUncertainty(relative=0.4, low_hz=100, high_hz=400),
        lbt.design.shaping.DelayError(frames=0.3),
        lbt.design.shaping.CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE),
        lbt.design.shaping.CommandRms(at_most_nm=30, turbulence=SLOW, noise_nm=NOISE, rate=True),
    ],
    ids=lambda d: d.label,
)
@pytest.mark.parametrize("seed", range(3))
def test_a_demand_holds_in_the_programme_where_it_holds_in_the_loop(demand, seed):
    mode = channel()
    grid = spec(demand).grid(mode).with_points(np.linspace(0, 400, 4001))
    constraints = demand.constraints(mode, grid)
    for size in (0.02, 0.1, 0.3, 1.0, 3.0):
        c = random_coefficients(12, seed) * size
        held = all(
            x.function.value(c) <= x.limit if hasattr(x, "limit") else np.max(x.use(c)) <= 1
            for x in constraints
        )
        loop = mode_loop(mode.hardware, mode.basis.parameter(c))
        if not loop.at(getattr(demand, "sensor_gain", 1.0)).is_stable:
            continue
        checks = demand.checks(loop)
        if all(abs(check.value / check.limit - 1) > 5e-3 for check in checks):  # not on the edge
            assert held == all(check.passed for check in checks)


@pytest.mark.parametrize(
    ("delay", "error"),
    [(1.0, 1.0), (1.5, 0.3), (2.0, 1.0), (2.3, 0.5), (2.5, 0.5), (2.7, 0.3), (3.0, 0.6)],
)
def test_a_loop_is_stable_at_every_delay_within_its_error(delay, error):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    eager = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=1.0)
    design = lbt.design.shape(
        path,
        spec(lbt.design.shaping.DelayError(frames=error), objective=eager),
        functions=20,
        states=None,
    )
    for e in np.linspace(-error, error, 41):
        real = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=max(delay + e, 1.0), modes=1)
        assert lbt.close_loop(real, design.controller).is_stable
    if delay == 2.5:  # without the demand it is not
        free = lbt.design.shape(path, spec(objective=eager), functions=20, states=None)
        late = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=3.0, modes=1)
        assert not lbt.close_loop(late, free.controller).is_stable


def test_a_narrow_line_of_a_tabulated_spectrum_is_not_missed():
    f0, w = 53.0, 1e-3  # 100 nm rms
    line = lbt.models.TabulatedSpectrum(
        frequency_hz=[1, f0 - w, f0, f0 + w, 300], density_nm2_hz=[1e-3, 1e-3, 1e4 / w, 1e-3, 1e-3]
    )
    bound = lbt.design.shaping.CommandRms(at_most_nm=10, turbulence=line, noise_nm=1e-3)
    design = lbt.design.shape(ONE, spec(bound), functions=20, states=None)
    loop = lbt.close_loop(ONE, design.controller)
    assert 100 * abs(loop.commanding().frequency_response([f0])[0, 0, 1]) < 10
    seen = lbt.design.shaping.ResidualVariance(turbulence=line, noise_nm=NOISE)
    rejecting = lbt.design.shape(ONE, spec(objective=seen), functions=30, states=None)
    left = 100 * abs(lbt.close_loop(ONE, rejecting.controller).sensitivity([f0])[0, 0, 0])
    assert left < rejecting.objective_nm[0]


@pytest.mark.parametrize(("at_most", "gain"), [(1.6, 1.5), (1.9, 1.5), (2.2, 1.3), (1.7, 0.45)])
def test_attenuation_near_the_edge_of_convexity_is_certified(at_most, gain):
    eager = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=2.0)
    mask = lbt.design.shaping.Attenuation(low_hz=0, high_hz=400, at_most=at_most, sensor_gain=gain)
    design = lbt.design.shape(ONE, spec(mask, objective=eager), functions=20, states=None)
    f = np.linspace(0, 400, 8001)
    loop = lbt.close_loop(ONE, design.controller, sensor_gain=gain)
    assert np.max(np.abs(loop.sensitivity(f))) < at_most


def test_nothing_to_reject_leaves_nothing():
    idle = lbt.design.shaping.ResidualVariance(turbulence=None, noise_nm=10, sensor_gain=0.5)
    design = lbt.design.shape(
        ONE,
        spec(lbt.design.shaping.ModulusMargin(at_least=0.5), objective=idle),
        functions=8,
        states=None,
    )
    assert design.objective_nm[0] < 1e-3


# -- designs against oracles --------------------------------------------------------------------
@pytest.mark.parametrize("delay", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("coefficients", [[0.99], [1.9, -0.93]])
def test_without_demands_the_optimum_is_the_kalman_filter(delay, coefficients):
    model = lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=20.0, frame_rate_hz=RATE)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=model, noise_nm=NOISE, modes=1, delay_frames=delay
    )
    objective = lbt.design.shaping.ResidualVariance(turbulence=model, noise_nm=NOISE)
    design = lbt.design.shape(plant.hardware, spec(objective=objective), functions=30, states=None)
    best = lbt.kalman(plant).rms
    assert best * (1 - 1e-7) <= design.objective_nm[0] <= best * 1.002


def test_few_poles_reach_the_kalman_filter_too():
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, noise_nm=NOISE, modes=1)
    design = lbt.design.shape(plant.hardware, spec(), functions=24, states=8, loss=0.01)
    assert design.states_per_mode <= 8
    assert design.objective_nm[0] <= lbt.kalman(plant).rms * 1.012
    assert design.loss <= 0.01


def test_every_demand_holds_in_a_loop_measured_by_other_means():
    demands = (
        lbt.design.shaping.ModulusMargin(at_least=0.55),
        lbt.design.shaping.NoisePeak(at_most=1.9),
        lbt.design.shaping.Attenuation(low_hz=0, high_hz=2, at_most=0.12),
        lbt.design.shaping.Attenuation(low_hz=4, high_hz=6, at_most=0.5, sensor_gain=0.6),
        lbt.design.shaping.SensorGainRange(low=0.3, high=1.6),
        lbt.design.shaping.MirrorUncertainty(relative=0.7, low_hz=150, high_hz=400),
        lbt.design.shaping.DelayError(frames=0.5),
        lbt.design.shaping.CommandRms(at_most_nm=40, turbulence=SLOW, noise_nm=NOISE, rate=True),
    )
    design = lbt.design.shape(ONE, spec(*demands), functions=30, states=None)
    free = lbt.design.shape(ONE, spec(), functions=30, states=None)
    assert design.objective_nm[0] > free.objective_nm[0]
    loop = lbt.close_loop(ONE, design.controller)
    f = np.linspace(0, 400, 8001)
    S = np.abs(loop.sensitivity(f)[:, 0, 0])
    T = np.abs(1 - loop.sensitivity(f)[:, 0, 0])
    assert np.max(S) < 1 / 0.55
    assert np.max(np.abs(loop.noise_transfer(f))) < 1.9
    assert np.max(S[f <= 2]) < 0.12
    weak = lbt.close_loop(ONE, design.controller, sensor_gain=0.6)
    assert np.max(np.abs(weak.sensitivity(f[(f >= 4) & (f <= 6)]))) < 0.5
    low, high = lbt.loop.stable_sensor_gains(ONE, design.controller)
    assert low < 0.3
    assert high > 1.6
    assert 0.7 * np.max(T[f >= 150]) < 1
    assert lbt.loop_margins(loop).delay_frames > 0.5
    run = lbt.simulate(
        design.controller,
        lbt.Truth(turbulence=SLOW, noise_nm=NOISE),
        hardware=ONE,
        frames=40_000,
        cases=1,
        seed=1,
        settle_frames=2000,
    )
    assert np.std(np.diff(run.commands[0, :, 0])) < 40 * 1.03


def test_terms_at_other_sensor_gains_are_lowered_step_by_step():
    weak = lbt.design.shaping.Total(terms=(BASIC, replace(BASIC, sensor_gain=0.4)))
    sequence = solve_sequence(
        spec(lbt.design.shaping.ModulusMargin(at_least=0.4), objective=weak), channel(16)
    )
    assert len(sequence.objectives_nm2) > 2
    assert np.all(np.diff(sequence.objectives_nm2) <= 1e-3 * np.array(sequence.objectives_nm2[:-1]))
    unaware = solve_sequence(
        spec(
            lbt.design.shaping.ModulusMargin(at_least=0.4),
            lbt.design.shaping.SensorGainRange(low=0.4, high=1),
        ),
        channel(16),
    )
    parameter = unaware.channel.basis.parameter(unaware.coefficients)
    assert sequence.objective_nm2 < weak.measured_nm2(mode_loop(ONE, parameter))


def test_the_worst_of_two_bands_is_balanced():
    bands = [
        lbt.design.shaping.VibrationBand(low_hz=10, high_hz=11, rms_nm=200),
        lbt.design.shaping.VibrationBand(low_hz=40, high_hz=42, rms_nm=200),
    ]
    objective = lbt.design.shaping.Total(
        terms=(BASIC, lbt.design.shaping.Worst(terms=tuple(bands))), weights=(0.1, 1)
    )
    design = lbt.design.shape(
        ONE,
        spec(lbt.design.shaping.ModulusMargin(at_least=0.4), objective=objective),
        functions=40,
        states=None,
    )
    (_, _, _), (_, _, low), (_, _, high) = design.terms_nm()
    assert low == pytest.approx(high, rel=0.02)


def test_each_mode_may_have_its_own_specification():
    still = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=NOISE)
    line = lbt.design.shaping.Total(
        terms=(still, lbt.design.shaping.VibrationBand(low_hz=19, high_hz=21, rms_nm=100))
    )
    sensor = np.array([[1.0, 0.3], [-0.2, 0.9], [0.4, 0.0]])
    mirror = np.array([[0.8, 0.1, 0.0], [0.0, 0.5, 0.4]])
    path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=sensor, influence_matrix=mirror)
    design = lbt.design.shape(
        path, [spec(objective=still), spec(objective=line)], functions=20, states=None
    )
    assert design.certificate.passed
    assert design.objective_nm[0] < design.objective_nm[1]
    rejected = np.abs(lbt.close_loop(path, design.controller).sensitivity([20.0])[0])
    assert rejected[1, 1] < 0.5 * rejected[0, 0]
    assert max(rejected[0, 1], rejected[1, 0]) < 1e-9


def test_robust_scales_the_noise_with_the_sensor_and_shares_equal_modes():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=SLOW, noise_nm=NOISE, sensor_matrix=np.diag([1.0, 2.0])
    )
    line = lbt.design.shaping.VibrationBand(low_hz=19, high_hz=21, rms_nm=100)
    design = lbt.robust(plant, bands=[line], functions=16, states=None)
    assert [s.objective.terms[0].noise_nm for s in design.specifications] == pytest.approx(
        [20.0, 10.0]
    )
    same = lbt.robust(replace_sensor(plant), bands=[line], functions=16, states=None)
    assert same.specifications[0] is same.specifications[1]
    assert same.method == "robust"


def replace_sensor(plant):
    return lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=plant.turbulence[0], noise_nm=NOISE)


# -- infeasible ---------------------------------------------------------------------------------
def test_a_smallest_set_of_clashing_demands_is_named():
    deep = lbt.design.shaping.Attenuation(low_hz=0, high_hz=50, at_most=0.2)
    stiff = lbt.design.shaping.ModulusMargin(at_least=0.7)
    idle = lbt.design.shaping.NoisePeak(at_most=50)
    with pytest.raises(
        lbt.errors.InfeasibleError, match="cannot hold together with 16 functions"
    ) as caught:
        lbt.design.shape(
            ONE,
            spec(idle, deep, lbt.design.shaping.SensorGainRange(low=0.9, high=1.1), stiff),
            functions=16,
            states=None,
        )
    assert set(caught.value.conflict) == {deep.label, stiff.label}
    assert "relaxed by a factor of" in str(caught.value)


def test_one_demand_may_be_impossible_by_itself():
    # with a delay of two frames the first two samples of S are 1 and 0: |S| < 1 everywhere fails
    with pytest.raises(
        lbt.errors.InfeasibleError, match="these demands cannot hold with"
    ) as caught:
        lbt.design.shape(
            ONE,
            spec(lbt.design.shaping.Attenuation(low_hz=0, high_hz=400, at_most=0.9)),
            functions=12,
            states=None,
        )
    assert len(caught.value.conflict) == 1


def test_the_relaxation_that_is_named_suffices():
    demands = (
        lbt.design.shaping.Attenuation(low_hz=0, high_hz=50, at_most=0.2),
        lbt.design.shaping.ModulusMargin(at_least=0.7),
    )
    with pytest.raises(lbt.errors.InfeasibleError) as caught:
        lbt.design.shape(ONE, spec(*demands), functions=16, states=None)
    factor = float(str(caught.value).split("factor of ")[1].split(")")[0])
    relaxed = replace(demands[0], at_most=0.2 * factor * 1.01)
    assert lbt.design.shape(
        ONE, spec(relaxed, demands[1]), functions=16, states=None
    ).certificate.passed


def test_too_few_states_for_the_loss_are_refused():
    objective = lbt.design.shaping.Total(
        terms=(BASIC, lbt.design.shaping.VibrationBand(low_hz=15, high_hz=25, rms_nm=500))
    )
    with pytest.raises(
        lbt.errors.InfeasibleError, match="no controller of 5 states a mode came within 1 %"
    ):
        lbt.design.shape(ONE, spec(objective=objective), functions=30, states=5, loss=0.01)


# -- gain files ----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def small():
    demands = (
        lbt.design.shaping.ModulusMargin(at_least=0.5),
        lbt.design.shaping.CommandRms(at_most_nm=200, turbulence=SLOW, noise_nm=NOISE, rate=True),
    )
    table = lbt.models.TabulatedSpectrum(frequency_hz=[1, 10, 100], density_nm2_hz=[500, 20, 0.1])
    objective = lbt.design.shaping.Total(
        terms=(
            lbt.design.shaping.ResidualVariance(turbulence=table, noise_nm=NOISE),
            lbt.design.shaping.VibrationBand(low_hz=9, high_hz=11, rms_nm=50),
        )
    )
    return lbt.design.shape(ONE, spec(*demands, objective=objective), functions=16, states=10)


@pytest.mark.parametrize("ending", [".fits", ".npz", ".json"])
def test_a_shaped_design_returns_from_its_gain_file(small, tmp_path, ending):
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / f"gain{ending}", small))
    assert isinstance(loaded, lbt.design.ShapedDesign)
    assert loaded.recertify().passed
    assert loaded.objective_nm == small.objective_nm
    assert [d.label for d in loaded.specifications[0].demands] == [
        d.label for d in small.specifications[0].demands
    ]
    assert loaded.terms_nm() == small.terms_nm()
    np.testing.assert_array_equal(loaded.controller.A, small.controller.A)


def test_a_changed_parameter_a_changed_demand_or_a_better_claim_fails_the_certificate(small):
    parameter = small.parameters[0]
    other = lbt.Controller(
        A=parameter.A, B=parameter.B, C=parameter.C * 1.01, D=parameter.D, dt_s=parameter.dt_s
    )
    failed = [
        c.name for c in replace(small, parameters=(other,)).recertify().checks if not c.passed
    ]
    assert "controller against its parameters" in failed
    stricter = replace(
        small.specifications[0], demands=(lbt.design.shaping.ModulusMargin(at_least=0.9),)
    )
    assert not replace(small, specifications=(stricter,)).recertify().passed
    assert not replace(small, objective_nm=(small.objective_nm[0] * 0.999,)).recertify().passed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(objective_nm=[-1.0]), "objective_nm must be above 0"),
        (lambda m: m.update(objective_nm=[0.0]), "objective_nm must be above 0"),
        (lambda m: m.update(long_objective_nm=["inf"]), "long_objective_nm must be a number"),
        (lambda m: m.update(objective_nm=[30.0, 30.0]), "one for each mode"),
        (
            lambda m: m.update(specifications=[{"kind": "ModulusMargin", "at_least": 0.5}]),
            "are none",
        ),
        (lambda m: m.update(specifications=[3]), "are none"),
        (
            lambda m: m["specifications"][0]["objective"]["terms"][1].update(high_hz=900.0),
            "below the Nyquist",
        ),
        (lambda m: m["specifications"][0].update(kind="Anything"), "Anything"),
    ],
)
def test_impossible_claims_of_a_gain_file_are_refused(small, tmp_path, change, message):
    path = lbt.save_gain(tmp_path / "gain.json", small)
    document = json.loads(path.read_text())
    change(document["meta"]["shaped"])
    arrays = {k: np.array(v) for k, v in document["arrays"].items()}
    meta = {k: v for k, v in document["meta"].items() if k != "digest"}
    document["meta"]["digest"] = _digest(arrays, meta)
    path.write_text(json.dumps(document))
    with pytest.raises(lbt.errors.GainFileError, match=message):
        lbt.load_gain(path)


# -- refusals --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: lbt.design.shaping.ResidualVariance(turbulence=None, noise_nm=0),
            "turbulence or noise; got neither",
        ),
        (
            lambda: lbt.design.shaping.ResidualVariance(turbulence=3, noise_nm=1),
            "must be an Atmosphere",
        ),
        (
            lambda: lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=-1),
            "noise_nm must be at least 0",
        ),
        (
            lambda: lbt.design.shaping.VibrationBand(low_hz=5, high_hz=5, rms_nm=1),
            "high_hz must be above 5",
        ),
        (
            lambda: lbt.design.shaping.VibrationBand(low_hz=5, high_hz=6, rms_nm=0),
            "rms_nm must be above 0",
        ),
        (lambda: lbt.design.shaping.Total(terms=()), "at least one term"),
        (lambda: lbt.design.shaping.Total(terms=(3,)), "an objective is made of"),
        (lambda: lbt.design.shaping.Worst(terms=(BASIC,), weights=(1, 2)), "one a term, 1; got 2"),
        (lambda: lbt.design.shaping.ModulusMargin(at_least=1), "at_least must be below 1"),
        (lambda: lbt.design.shaping.NoisePeak(at_most=0), "at_most must be above 0"),
        (
            lambda: lbt.design.shaping.Attenuation(low_hz=0, high_hz=1, at_most=3, sensor_gain=0.5),
            "at_most must be below 2 at sensor gain 0.5",
        ),
        (lambda: lbt.design.shaping.SensorGainRange(low=1.1, high=1.3), "low must be at most 1"),
        (lambda: lbt.design.shaping.SensorGainRange(low=0.5, high=0.9), "high must be at least 1"),
        (lambda: lbt.design.shaping.DelayError(frames=1.5), "frames must be at most 1"),
        (
            lambda: lbt.design.shaping.MirrorUncertainty(relative=0, low_hz=0, high_hz=1),
            "relative must be above 0",
        ),
        (
            lambda: lbt.design.shaping.CommandRms(at_most_nm=-1, turbulence=SLOW, noise_nm=1),
            "at_most_nm must be above 0",
        ),
        (lambda: spec(3), "a demand must be one of ModulusMargin"),
        (lambda: spec(objective=3), "an objective is made of"),
        (lambda: lbt.design.shape(3, spec()), "hardware must be a LoopHardware"),
        (lambda: lbt.design.shape(ONE, 3), "expected a Specification"),
        (lambda: lbt.design.shape(ONE, [spec(), spec()]), "one for each of 1 modes; got 2"),
        (lambda: lbt.design.shape(ONE, spec(), functions=401), "functions must be at most 400"),
        (lambda: lbt.design.shape(ONE, spec(), pole=1.0), "pole must be below 1"),
        (lambda: lbt.design.shape(ONE, spec(), states=1), "states must be at least 2"),
        (
            lambda: lbt.design.shape(
                ONE,
                spec(objective=lbt.design.shaping.VibrationBand(low_hz=5, high_hz=500, rms_nm=1)),
            ),
            "below the Nyquist frequency 400 Hz; got 5 to 500",
        ),
        (
            lambda: lbt.design.shape(
                lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[1.0, 1.0]]), spec()
            ),
            "sensor_matrix must have rank 2",
        ),
        (
            lambda: lbt.design.shape(
                ONE,
                spec(
                    lbt.design.shaping.CommandRms(at_most_nm=9, turbulence=OTHER_RATE, noise_nm=1)
                ),
            ),
            "sampled at the loop's 800 Hz; got 100",
        ),
        (
            lambda: lbt.design.shaping.CommandRms(
                at_most_nm=9, turbulence=SLOW, noise_nm=1, rate="x"
            ),
            "rate must be True or False",
        ),
        (lambda: lbt.design.shaping.Total(terms=BASIC), "terms must be a list"),
        (
            lambda: lbt.design.shaping.Specification(
                objective=BASIC, demands=lbt.design.shaping.NoisePeak(at_most=3)
            ),
            "demands must be a list",
        ),
        (lambda: lbt.robust(plant_of_one(), bands=None), "bands must be a list"),
        (lambda: lbt.robust(plant_of_one(), bands=[], sensor_gain=(1,)), r"must be \(low, high\)"),
        (lambda: lbt.robust(plant_of_one(), bands=[], scenarios=1.0), "scenarios must be a list"),
        (
            lambda: lbt.studies.robustness_map(
                None,
                lbt.Truth(turbulence=None),
                lbt.Imaging(diameter_m=8),
                errors_hz=[0],
                sensor_gains=[1],
            ),
            "expected a Design",
        ),
        (lambda: lbt.loop.least_residual(None, None), "expected a LoopHardware"),
        (lambda: lbt.robust(3, bands=[]), "plant must be a TipTiltPlant"),
        (
            lambda: lbt.robust(replace_sensor(plant_of_one()), bands=[3]),
            "bands must be VibrationBands",
        ),
        (lambda: lbt.robust(plant_of_one(), bands=[], scenarios=[]), "at least one sensor gain"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        make()


def plant_of_one():
    return lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, noise_nm=NOISE, modes=1)


def test_noise_of_any_size_stays_with_its_mode():
    tiny = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=1e-11, frame_rate_hz=RATE)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=tiny, noise_nm=4e-10, sensor_matrix=np.diag([1.0, 3.0])
    )
    design = lbt.robust(plant, bands=[], functions=8, states=None)
    noise = [s.objective.terms[0].noise_nm for s in design.specifications]
    assert noise == pytest.approx([4e-10, 4e-10 / 3], rel=1e-6)


def test_few_states_may_be_as_few_as_are_needed():
    design = lbt.design.shape(ONE, spec(), functions=20, states=4, loss=0.01)
    assert design.states_per_mode == 2


def test_poles_of_a_response_are_found():
    poles = np.array([0.97 * np.exp(0.2j), 0.97 * np.exp(-0.2j), 0.5, 0.85])
    angles = np.linspace(0, np.pi, 400)
    z = np.exp(1j * angles)
    target = z**2 * (z + 0.3) * z / np.prod(z[:, None] - poles, axis=1)
    start = np.array([0.9 * np.exp(0.3j), 0.9 * np.exp(-0.3j), 0.1, 0.7])
    found, misfit = fit_poles(angles, target, np.ones(400), start)
    assert misfit < 1e-6
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(poles), atol=1e-4)
