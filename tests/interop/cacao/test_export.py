"""Predictive filters of cacao, read back and run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from support.recorded_runs import recorded_run
from support.shaping import attenuation

import lbt_synth as lbt
from lbt_synth.interop.cacao.export import AppliedFilter, PredictiveFilter, predictive_filter
from lbt_synth.interop.proof import mode_variances, prove_written
from lbt_synth.loop.closed_loop import youla_controller

STEPS = 40
AIR = lbt.models.ARModel(coefficients=np.array([0.99]), driving_rms_nm=40.0, frame_rate_hz=800)


def make_design(modes=1, **options):
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, noise_nm=15.0, modes=modes, **options
    )
    return lbt.kalman(plant)


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A Kalman filter whose two axes are coupled by an oblique line, and its export."""
    line = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(0.6, 0.8))
    design = make_design(2, vibrations=[line])
    file = tmp_path_factory.mktemp("turned") / "pf.fits"
    return design, lbt.interop.export(file, design, "cacao", steps=STEPS, gain_digest="ab" * 32)


@pytest.fixture
def path():
    return lbt.LoopHardware(frame_rate_hz=800, modes=1)


def test_the_matrix_is_the_controller_in_its_loop(turned):
    """Its columns are what the running controller answers to a pulse of pseudo-open-loop."""
    design, written = turned
    with fits.open(written.files[0], checksum=True) as units:
        matrix = units[0].data
    assert (matrix.shape, matrix.dtype) == ((2, 2 * STEPS), ">f4")
    for mode in range(2):
        pulse = np.zeros((1, STEPS, 2))
        pulse[0, 0, mode] = 1.0
        rest = np.zeros((1, STEPS, 2))
        run = recorded_run(design.controller.start(), design.hardware, rest, pulse)
        assert np.allclose(-matrix[:, mode::2].T, run[0, :, 2:4], rtol=1e-6, atol=1e-7)
    assert abs(matrix[0, 1]) > 1e-3  # the axes are coupled
    assert written.error < 0.02
    beside = json.loads(written.files[1].read_text())
    assert (beside["steps"], beside["modes"], beside["latency_frames"]) == (STEPS, 2, 3.0)


def cut_controller(taps, hardware):
    """The controller of a filter with these taps (steps, m, m), its history as the state."""
    steps, m, _ = taps.shape
    each = np.eye(m)
    history = lbt.Controller(
        A=np.kron(np.eye(steps, k=-1), each),
        B=np.kron(np.eye(steps, 1), each),
        C=np.hstack([np.zeros((m, m)), *taps[1:]]),
        D=taps[0],
        dt_s=hardware.dt_s,
    )
    return youla_controller(hardware, history)


@pytest.mark.parametrize("steps", [20, 200])
@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_the_bound_on_the_loss_holds(steps, gain):
    """The exact residual of the cut filter, by its own loop, is below the bound."""
    design = make_design(
        vibrations=[lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300.0, direction=(1.0,))]
    )
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


def test_sensitivities_change_by_no_more_than_the_bound():
    """A cut filter of two coupled axes, whose loop is closed around its taps."""
    line = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(0.6, 0.8))
    design = make_design(2, vibrations=[line])
    found = predictive_filter(design)
    norm = found.cut_norm(STEPS)
    written = cut_controller(found.taps(STEPS), design.hardware)
    frequency = np.linspace(0.5, 399.5, 400)
    for gain in (0.6, 1.0, 1.3):
        own, other = (
            lbt.close_loop(design.hardware, c, sensor_gain=gain).sensitivity(frequency)
            for c in (design.controller, written)
        )
        change = np.max(np.linalg.norm(other - own, 2, axis=(1, 2)))
        bound = found.response(gain, norm)
        assert 0.02 * bound < change <= bound


def test_the_small_gain_is_that_of_the_closed_form(path):
    """An integrator g: Q = g z^2 (1 - 1/z) / (z^2 - z + g), and a cut after two steps."""
    design = lbt.integrator(path, gain=0.3)
    found = predictive_filter(design)
    taps = found.taps(2)
    assert np.allclose(taps[:, 0, 0], [0.3, 0.3])
    z = np.exp(1j * np.linspace(1e-4, np.pi, 20001))
    q = 0.3 * z**2 / (z**2 - z + 0.3)
    left_out = np.max(np.abs(q - 0.3 - 0.3 / z))
    low, high = design.hardware and lbt.loop.stable_sensor_gains(path, design.controller)
    expected = 0.0
    for gain in np.geomspace(max(1.01 * low, 0.1), min(high / 1.01, 10.0), 9):
        s = 1 / (1 + gain * 0.3 / (z * (z - 1)))
        expected = max(expected, abs(1 - gain) * np.max(np.abs(s + (1 - s) / gain)) * left_out)
    bound = found.cut_norm(2) / found.least_distance(0.0)
    assert expected < 1.0001 * bound
    assert bound < 2.0001 * expected


def test_the_small_gain_holds_between_the_gains_that_are_computed(path, monkeypatch):
    """A loop that is nearly unstable at sensor gain 0.128 alone."""
    found = predictive_filter(lbt.integrator(path, gain=0.3))
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


def test_rounding_is_bounded_by_a_loop_in_that_arithmetic(path):
    """The same taps in single and in double precision; the proof has what this noise leaves."""
    design = lbt.integrator(path, gain=0.3)
    found = predictive_filter(design)
    matrix = -found.taps(60)[:, 0].T.astype(np.float32)
    taps = -matrix.astype(float).T[:, :, None]
    checks = prove_written(design, found.as_computed(taps))
    how = next(check.computed_by for check in checks if "sensor gain 1," in check.name)
    bound = float(how.split("rounding at most ")[1].split(" of it")[0])
    rng = np.random.default_rng(0)
    total = 300 * np.cumsum(rng.standard_normal((1, 3000, 1)), axis=1) / 30
    rest = np.zeros((1, 3000, 1))
    single, double = (
        recorded_run(run, path, total, rest)[0]
        for run in (AppliedFilter(matrix), cut_controller(taps, path).start())
    )
    assert 0 < np.std(single[:, 0] - double[:, 0]) < 3 * bound * np.std(double[:, 0])


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
    shaping = lbt.design.shaping
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    air = shaping.ResidualVariance(turbulence=replace(AIR, frame_rate_hz=500), noise_nm=15.0)
    spec = shaping.Specification(terms=[air], demands=[demand])
    design = lbt.design.shape(path, spec, functions=8, states=None)
    found = predictive_filter(design)
    steps = found.fewest_steps(0.01)
    taps = found.taps(steps).astype(np.float32).astype(float)
    checks = prove_written(design, found.as_computed(taps))
    loop = shaping.channel.SingleModeLoop(hardware=path, controller=cut_controller(taps, path))
    exact = [check for one in design.specifications[0].demands for check in one.checks(loop)]
    proved = [check for check in checks if check.name.startswith("mode 1: ")]
    assert [check.name.removeprefix("mode 1: ") for check in proved] == [e.name for e in exact]
    for one, own in zip(proved, exact, strict=True):
        assert own.value <= one.value <= own.value + 0.05
        assert one.limit == pytest.approx(1.01 * own.limit)


def test_a_demand_that_no_response_bounds_is_refused(tmp_path):
    shaping = lbt.design.shaping
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    spec = shaping.Specification(
        terms=[shaping.ResidualVariance(turbulence=AIR, noise_nm=15.0)],
        demands=[shaping.CommandRms(at_most_nm=1e4, turbulence=AIR, noise_nm=15.0)],
    )
    design = lbt.design.shape(path, spec, functions=8, states=None)
    with pytest.raises(lbt.errors.ProblemError, match="got command stroke of at most .* such as c"):
        lbt.interop.export(tmp_path / "pf.fits", design, "cacao")
    assert not list(tmp_path.iterdir())


def test_what_the_filter_cannot_hold_is_refused_with_the_number(tmp_path, path):
    def refused(kind, match, design, **options):
        with pytest.raises(kind, match=match):
            lbt.interop.export(tmp_path / "pf.fits", design, "cacao", **options)
        assert not list(tmp_path.iterdir())

    problem, failed = lbt.errors.ProblemError, lbt.errors.NumericalError
    slow = lbt.integrator(path, gain=0.1)
    refused(failed, r"arithmetic of cacao .* is .* Give more steps", slow, steps=8)
    for damping, text in ((1e-5, "at most 1 % of residual"), (1e-4, r"numbers; got \d{4,} steps")):
        line = lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=3.0, direction=(1.0,))
        refused(failed, text, make_design(vibrations=[line]), modes=200)
    refused(problem, "steps must be at least 2", slow, steps=1)
    late = replace(path, delay_frames=9.0)
    refused(problem, "delay of at most 8", lbt.integrator(late, gain=0.02))
    blind = lbt.integrator(replace(path, sensor_matrix=np.array([[0.3]])), gain=0.5)
    refused(problem, "counts with a sensor gain of 1, at which .* is unstable", blind)
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    refused(problem, "needs the design of a loop", bare)


def reference(matrix, latency, series):
    """Frame by frame as modalfilter.c and applyPF.c do, with their ring and their indices."""
    single = np.float32
    matrix = np.asarray(matrix, single)
    modes, columns = matrix.shape
    ring, write = np.zeros((10, modes), single), 0
    inbuff = np.zeros(columns, single)
    whole = int(latency)
    part = single(latency - whole)
    out = []
    for y in np.asarray(series, single):
        # the command of this frame is written after it is known, where index 0 frames ago is
        now = (write + 1) % 10
        one, two = (now - whole) % 10, (now - whole - 1) % 10
        for mode in range(modes):
            late = single(part * ring[two, mode])
            late = single(float(late) + (1.0 - float(part)) * float(ring[one, mode]))
            inbuff[mode] = single(y[mode] - late)
        applied = np.zeros(modes, single)
        for mode in range(modes):
            for i in range(columns):
                applied[mode] = single(applied[mode] + single(inbuff[i] * matrix[mode, i]))
        inbuff[modes:] = inbuff[:-modes].copy()
        ring[write] = applied
        write = now
        out.append(-applied)
    return np.array(out, dtype=float)


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.25, 8.0])
def test_every_bit_is_that_of_the_program(delay):
    rng = np.random.default_rng(1)
    matrix, series = rng.standard_normal((2, 10)) / 4, rng.standard_normal((40, 2))
    run = AppliedFilter(matrix, delay)
    for _ in range(2):
        found = np.array([run.step(y) for y in series])
        assert np.array_equal(found, reference(matrix, delay + 1, series))
        run.reset()
