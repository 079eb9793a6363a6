"""Predictive filters of cacao, read back and run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from support.exports import CacaoProgram
from support.recorded_runs import recorded_run
from support.refusals import require_refusals
from support.shaping import attenuation, shaped

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import SingleModeLoop
from lbt_synth.interop.cacao.export import AppliedFilter, PredictiveFilter, predictive_filter
from lbt_synth.interop.proof import mode_variances, prove_written
from lbt_synth.loop.closed_loop import youla_controller

STEPS = 40
AIR = lbt.models.ARModel(coefficients=np.array([0.99]), driving_rms_nm=40.0, frame_rate_hz=800)
PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def make_design(*vibrations, modes=1):
    models = {"turbulence": AIR, "noise_nm": 15.0, "vibrations": vibrations, "modes": modes}
    return lbt.kalman(lbt.tip_tilt_plant(frame_rate_hz=800, **models))


def line(damping, rms_nm):
    return lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=rms_nm, direction=(1.0,))


@pytest.fixture(scope="module")
def turned():
    """A Kalman filter whose two axes are coupled by an oblique line."""
    slanted = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(0.6, 0.8))
    return make_design(slanted, modes=2)


def test_the_matrix_is_the_controller_in_its_loop(tmp_path, turned):
    """Its columns are what the running controller answers to a pulse of pseudo-open-loop."""
    written = lbt.interop.export(tmp_path / "pf.fits", turned, "cacao", steps=STEPS)
    with fits.open(written.files[0], checksum=True) as units:
        matrix = units[0].data
    assert (matrix.shape, matrix.dtype) == ((2, 2 * STEPS), ">f4")
    for mode in range(2):
        pulse = np.zeros((1, STEPS, 2))
        pulse[0, 0, mode] = 1.0
        run = recorded_run(turned.controller.start(), turned.hardware, 0 * pulse, pulse)
        assert np.allclose(-matrix[:, mode::2].T, run[0, :, 2:4], rtol=1e-6, atol=1e-7)
    assert abs(matrix[0, 1]) > 1e-3  # the axes are coupled
    assert written.error < 0.02
    beside = json.loads(written.files[1].read_text())
    assert (beside["steps"], beside["modes"], beside["latency_frames"]) == (STEPS, 2, 3.0)


def cut_controller(taps, hardware):
    """The controller of a filter with these taps (steps, m, m), its history as the state."""
    steps, m, _ = taps.shape
    A, B = (np.kron(shift, np.eye(m)) for shift in (np.eye(steps, k=-1), np.eye(steps, 1)))
    C = np.hstack([np.zeros((m, m)), *taps[1:]])
    history = lbt.Controller(A=A, B=B, C=C, D=taps[0], dt_s=hardware.dt_s)
    return youla_controller(hardware, history)


@pytest.mark.parametrize("steps", [20, 200])
@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_the_bound_on_the_loss_holds(steps, gain):
    """The exact residual of the cut filter, by its own loop, is below the bound."""
    design = make_design(line(0.01, 300.0))
    found = predictive_filter(design)
    written = cut_controller(found.taps(steps), design.hardware)
    loops = [
        lbt.close_loop(design.hardware, c, sensor_gain=gain) for c in (design.controller, written)
    ]
    before, after = (np.sqrt(mode_variances(design, loop, slice(1)))[0] for loop in loops)
    if gain == 1 and steps == 20:
        own = lbt.residual_budget(loops[1], design.problem, frame_means=True).rms_nm
        assert after == pytest.approx(own, rel=1e-9)
    bound = found.residual_nm(gain, found.cut_norm(steps)) / before
    assert -1e-9 < after / before - 1 <= bound + 1e-9
    assert bound < (1e-3 if steps == 200 else np.inf)


def test_the_length_is_the_shortest_that_meets_the_loss():
    found = predictive_filter(make_design())
    fewest = found.fewest_steps(0.01)

    def losses(steps):
        norm = found.cut_norm(steps)
        lost = (found.residual_nm(gain, norm) / own for gain, (_, own) in found.sizes_nm.items())
        return [norm, *lost]

    assert np.max(losses(fewest)) <= 0.01 < 1.03 * np.max(losses(fewest - 1))


def test_sensitivities_change_by_no_more_than_the_bound(turned):
    """A cut filter of two coupled axes, whose loop is closed around its taps."""
    predictive, path = predictive_filter(turned), turned.hardware
    norm, taps = predictive.cut_norm(STEPS), predictive.taps(STEPS)
    frequency = np.linspace(0.5, 399.5, 400)
    for gain in (0.6, 1.0, 1.3):
        before, after = (
            lbt.close_loop(path, controller, sensor_gain=gain).sensitivity(frequency)
            for controller in (turned.controller, cut_controller(taps, path))
        )
        change = np.max(np.linalg.norm(after - before, 2, axis=(1, 2)))
        bound = predictive.response(gain, norm)
        assert 0.02 * bound < change <= bound


def test_the_small_gain_is_that_of_the_closed_form():
    """An integrator g: Q = g z^2 (1 - 1/z) / (z^2 - z + g), and a cut after two steps."""
    design = lbt.integrator(PATH, gain=0.3)
    found = predictive_filter(design)
    taps = found.taps(2)
    assert np.allclose(taps[:, 0, 0], [0.3, 0.3])
    z = np.exp(1j * np.linspace(1e-4, np.pi, 20001))
    q = 0.3 * z**2 / (z**2 - z + 0.3)
    left_out = np.max(np.abs(q - 0.3 - 0.3 / z))
    low, high = lbt.loop.stable_sensor_gains(PATH, design.controller)
    expected = 0.0
    for gain in np.geomspace(max(1.01 * low, 0.1), min(high / 1.01, 10.0), 9):
        s = 1 / (1 + gain * 0.3 / (z * (z - 1)))
        expected = max(expected, abs(1 - gain) * np.max(np.abs(s + (1 - s) / gain)) * left_out)
    bound = found.cut_norm(2) / found.least_distance(0.0)
    assert expected < 1.0001 * bound
    assert bound < 2.0001 * expected


def test_the_small_gain_holds_between_the_gains_that_are_computed(monkeypatch):
    """A loop that is nearly unstable at sensor gain 0.128 alone."""
    found = predictive_filter(lbt.integrator(PATH, gain=0.3))
    steepness, tried = float(lbt.linear.hinf_norm(found.system)), []

    def at(_, gain):
        tried.append(gain)
        return None, None, 1 / (1e-3 + min(steepness * abs(gain - 0.128), 0.3))

    monkeypatch.setattr(PredictiveFilter, "at", at)
    coarse = [found._distance(gain) for gain in np.geomspace(*found.interval, 9)]
    assert min(coarse) > 0.01
    least = 1e-3 / (1 - 0.128)
    assert 0.5 * least <= found.least_distance(0.0) <= least
    assert found.least_distance(2 * least) <= 2 * least  # and no more than is enough
    tried.clear()
    assert found.small_gain(5e-3) >= 1
    assert len(set(tried)) < 60


def test_rounding_is_bounded_by_a_loop_in_that_arithmetic():
    """The same taps in single and in double precision; the proof has what this noise leaves."""
    design = lbt.integrator(PATH, gain=0.3)
    found = predictive_filter(design)
    matrix = -found.taps(60)[:, 0].T.astype(np.float32)
    taps = -matrix.astype(float).T[:, :, None]
    checks = prove_written(design, found.as_computed(taps))
    how = next(check.computed_by for check in checks if "sensor gain 1," in check.name)
    bound = float(how.split("rounding at most ")[1].split(" of it")[0])
    rng = np.random.default_rng(0)
    total = 300 * np.cumsum(rng.standard_normal((1, 3000, 1)), axis=1) / 30
    single, double = (
        recorded_run(run, PATH, total, 0 * total)[0]
        for run in (AppliedFilter(matrix), cut_controller(taps, PATH).start())
    )
    assert 0 < np.std(single[:, 0] - double[:, 0]) < 3 * bound * np.std(double[:, 0])


VARIANCE = lbt.design.shaping.ResidualVariance(turbulence=AIR, noise_nm=15.0)


@pytest.mark.parametrize(
    "demand",
    [
        attenuation(0, 2, 0.2, sensor_gain=0.7),
        lbt.design.shaping.LoopErrors(delay_frames=0.2),
        lbt.design.shaping.Bound(response="complementary", at_most=2.5, low_hz=150, high_hz=250),
    ],
    ids=lambda demand: demand.label,
)
def test_demands_are_moved_by_what_is_left_out(demand):
    """The value of each demand in the certificate is above that of the loop around the taps."""
    design = shaped(demand, terms=[VARIANCE], path=PATH, functions=8)
    predictive = predictive_filter(design)
    taps = predictive.taps(predictive.fewest_steps(0.01)).astype(np.float32).astype(float)
    checks = prove_written(design, predictive.as_computed(taps))
    loop = SingleModeLoop(hardware=PATH, controller=cut_controller(taps, PATH))
    exact = [check for one in design.specifications[0].demands for check in one.checks(loop)]
    proved = [check for check in checks if check.name.startswith("mode 1: ")]
    assert [check.name.removeprefix("mode 1: ") for check in proved] == [e.name for e in exact]
    for one, own in zip(proved, exact, strict=True):
        assert own.value <= one.value <= own.value + 0.05
        assert one.limit == pytest.approx(1.01 * own.limit)


def test_what_the_filter_cannot_hold_is_refused(tmp_path):
    """With the number where steps are missing, and where no response bounds a demand."""

    def write(design, **options):
        return lambda: lbt.interop.export(tmp_path / "pf.fits", design, "cacao", **options)

    problem, failed = lbt.errors.ProblemError, lbt.errors.NumericalError
    slow, late = lbt.integrator(PATH, gain=0.1), replace(PATH, delay_frames=9.0)
    blind = lbt.integrator(replace(PATH, sensor_matrix=np.array([[0.3]])), gain=0.5)
    stroke = lbt.design.shaping.CommandRms(at_most_nm=1e4, turbulence=AIR, noise_nm=15.0)
    held = shaped(stroke, terms=[VARIANCE], path=PATH, functions=8)
    many, few = make_design(line(1e-5, 3.0)), make_design(line(1e-4, 3.0))
    words = "counts with a sensor gain of 1, at which .* is unstable"
    require_refusals(
        [
            (write(slow, steps=8), failed, r"arithmetic of cacao .* is .* Give more steps"),
            (write(many, modes=200), failed, "at most 1 % of residual"),
            (write(few, modes=200), failed, r"numbers; got \d{4,} steps"),
            (write(slow, steps=1), problem, "steps must be at least 2"),
            (write(lbt.integrator(late, gain=0.02)), problem, "delay of at most 8"),
            (write(blind), problem, words),
            (write(held), problem, "got command stroke of at most .* such as c"),
        ]
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.25, 8.0])
def test_every_bit_is_that_of_the_program(delay):
    rng = np.random.default_rng(1)
    matrix, series = rng.standard_normal((2, 10)) / 4, rng.standard_normal((40, 2))
    run = AppliedFilter(matrix, delay)
    program = CacaoProgram(matrix, delay + 1)
    for _ in range(2):
        found, expected = ([k.step(y) for y in series.astype(np.float32)] for k in (run, program))
        assert np.array_equal(found, expected)
        run.reset()
        program.reset()
