"""Matrices of dao real-time computers, read back and run."""

import json
from dataclasses import replace
from functools import partial
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.signal import lfilter
from support.exports import DifferenceEquation
from support.lqg import slow_plant
from support.recorded_loops import slanted_record
from support.recorded_runs import recorded_run
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.dao import export as dao
from lbt_synth.interop.proof import _rounding_left, prove_written
from lbt_synth.linear.norms import band_norm
from lbt_synth.loop.disturbances import draw_disturbance
from lbt_synth.loop.stable_range import affine_radii, parts_by_gain

BALANCE = 1e-13  # of a coefficient


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_matrix_holds_the_controller(tmp_path, designs, name):
    design = designs[name]
    written = lbt.interop.export(tmp_path / "K_mat.npy", design, "dao", modes=5)
    beside = json.loads(written.files[1].read_text())
    assert (beside["order"], beside["modes"], beside["notes"]) == (20, 5, [])
    matrix = np.load(written.files[0])
    assert (matrix.dtype, matrix.shape) == (np.float32, (41, 5))
    assert matrix.flags.c_contiguous
    assert not matrix[:, 2:].any()
    assert written.error < 1e-4
    rows = dao.direct_form_rows(design.controller, 20)
    assert np.array_equal(matrix[:, :2], rows.astype(np.float32))


def written_radius(matrix, low, high):
    """Largest spectral radius of the loop of two frames, from the polynomial of the numbers."""
    b, a = np.split(matrix[:, 0].astype(float), [len(matrix) // 2 + 1])
    gains = np.geomspace(low, high, 400)
    polynomials = [np.r_[1.0, -a, 0.0, 0.0] + np.r_[0.0, 0.0, gain * b] for gain in gains]
    return max(np.max(np.abs(np.roots(polynomial))) for polynomial in polynomials)


def test_a_shaped_design_that_single_precision_breaks_is_made_again(tmp_path, shaped):
    """In the arithmetic of the computer the loop leaves what the design leaves in double."""
    written = lbt.interop.export(tmp_path / "k.npy", shaped, "dao", order=20)
    matrix = np.load(written.files[0])
    assert matrix.shape == (41, 1)
    assert written_radius(matrix, 0.5, 1.2) < 1
    beside = json.loads((tmp_path / "k.npy.certificate.json").read_text())
    assert written.notes[0].startswith("made again for single precision")
    assert beside["notes"] == list(written.notes)
    air, line, *_ = shaped.specifications[0].terms
    vibration = lbt.models.SinusoidalVibration(
        frequency_hz=20.0, rms_nm=line.rms_nm, direction=(1.0,)
    )
    truth = lbt.Truth(turbulence=air.turbulence, noise_nm=air.noise_nm, vibrations=[vibration])
    drawn = draw_disturbance(truth, shaped.hardware, frames=6000, seed=1)
    exact, single = (
        np.std(recorded_run(run, shaped.hardware, drawn.phase_nm, drawn.noise)[0, 1000:, 0])
        for run in (shaped.controller.start(), dao.InnerLoop(matrix))
    )
    assert single == pytest.approx(exact, rel=0.03)
    assert single < 0.3 * np.std(drawn.phase_nm)


def test_a_sensor_gain_is_in_what_is_made_again(shaped):
    """The same loop with a sensor of gain 0.5: coefficients of measurements are twice as large."""
    half = replace(shaped.hardware, sensor_matrix=np.array([[0.5]]))
    (spec,) = shaped.specifications
    design = lbt.design.shape(half, spec, functions=12, states=None)
    plain, made = (
        dao.make_again(one, dao.direct_form_rows(one.controller, 20)) for one in (shaped, design)
    )
    # to what the programmes leave open, and what makes up for the rounding of other coefficients
    assert made[:21] == pytest.approx(2 * plain[:21], rel=2e-3, abs=2e-6)
    assert all(check.passed for check in prove_written(design, dao._as_computed(design, made)))


@pytest.mark.study
def test_the_robust_example_runs_in_single_precision(tmp_path):
    """Twelve states per axis, whose own coefficients reach a spectral radius of 1.162."""
    design = lbt.load_config("examples/lbt_robust.yaml").design("robust")
    written = lbt.interop.export(tmp_path / "k.npy", design, "dao")
    losses = [check.value for check in written.checks if "residual" in check.name]
    assert len(losses) == 4
    assert max(losses) < 0.01
    assert written_radius(np.load(written.files[0]), 0.25, 1.3) < 1


def test_what_the_matrix_cannot_hold_is_refused(tmp_path, config, designs):
    """The order leaves out the states of the other mode, and a delay in both polynomials."""
    turned = replace(config.hardware, sensor_matrix=[[1, 0.1], [0, 1]])
    lines = lbt.models.spread_plant(config.plant, half_width_hz=1.0, lines=3)
    slanted = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=500, direction=(0.6, 0.8))
    direct = lbt.Controller(A=[[0.0]], B=[[0.0, 0.0]], C=[[0.0], [0.0]], D=[[1.0, 0.0], [0.5, 1.0]])
    wide = lbt.Controller(A=[[0.5]], B=[[1.0, 2.0]], C=[[1.0]], D=[[0.0, 0.0]])
    big = lbt.Controller(A=np.eye(2, k=1), B=[[0.0], [1e30]], C=[[1e30, 0.0]], D=[[0.0]])
    with np.errstate(over="ignore"):
        rows_of_big = dao.direct_form_rows(big, 2).astype(np.float32)

    def write(design, **options):
        return lambda: lbt.interop.export(tmp_path / "k.npy", design, "dao", **options)

    coupled = lbt.kalman(slow_plant(modes=2, vibrations=[slanted])).controller
    words = r"here measurement 2 moves command 1\..*record, try .*separate_axes=True"
    rows = [
        (write(designs["kalman"], order=3), ProblemError, "order must be at least 4"),
        (write(designs["kalman"], modes=1), ProblemError, "modes must be at least 2"),
        (write(lbt.integrator(turned, gain=0.3)), ProblemError, "sensor_matrix must be diagonal"),
        (partial(dao.mode_polynomials, coupled), ProblemError, words),
        (partial(dao.mode_polynomials, direct), ProblemError, "here measurement 1 moves command 2"),
        (partial(dao.mode_polynomials, wide), ProblemError, "got 1 commands and 2 measurements"),
    ]
    rows += [
        (partial(dao.direct_form, np.array(beyond), 1.0), NumericalError, "beyond its range")
        for beyond in (rows_of_big, [[np.inf], [0.0], [1.0]], [[np.nan], [0.0], [1.0]])
    ]
    require_refusals(rows)
    words = "residual at sensor gain 1, loss is .* Give a higher, even order"
    assert refused(write(lbt.kalman(lines), order=16), NumericalError, words).residual > 0.01
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("method", ["kalman", "predictor"])
def test_a_record_of_mixing_axes_reaches_the_matrix_with_separate_axes(tmp_path, method):
    """A line at 30 degrees; without the option the refusal names it, for scripts and terminals."""
    made = partial(
        lbt.design_from_record, slanted_record(), method=method, sensor_gain=1.0, most_lines=1
    )
    mixed, apart = made(), made(separate_axes=True)
    words = r"must decouple.*design_from_record\(record, separate_axes=True\)"
    write = partial(lbt.interop.export, tmp_path / "k.npy", target="dao")
    error = refused(lambda: write(mixed.design), ProblemError, words)
    assert "lbt-synth auto --separate-axes" in error.at_terminal
    written = write(apart.design)
    assert all(check.passed for check in written.checks)
    # it costs what both axes tell of the line
    *_, with_both = apart.held_out.entries
    assert with_both.name == f"{apart.name}, axes mixed"
    assert with_both.replayed_nm == mixed.held_out[mixed.name].replayed_nm
    assert with_both.replayed_nm < apart.held_out[apart.name].replayed_nm


@pytest.mark.parametrize("lines_hz", [(20,), range(70, 230, 18)])
def test_a_matrix_has_the_order_and_the_factor_that_a_design_needs(tmp_path, lines_hz):
    """One narrow line, and nine, which need more than order 20; plain coefficients lose 1 %."""
    slow = -np.poly(0.9995 * np.exp([0.005j, -0.005j, -0.02])).real[1:]
    air = lbt.models.ARModel(coefficients=slow, driving_rms_nm=0.02, frame_rate_hz=800)
    lines = [lbt.Vibration(frequency_hz=f, damping=1e-3, rms_nm=300) for f in lines_hz]
    design = lbt.kalman(slow_plant(modes=2, turbulence=air, vibrations=lines))
    written = lbt.interop.export(tmp_path / "k.npy", design, "dao")
    matrix = np.load(written.files[0]).astype(float)
    M = len(matrix) // 2
    assert json.loads(written.files[1].read_text())["order"] == M
    assert (M > 20) == (len(lines_hz) > 1) == (f"is for M = {M} in the" in written.notes[0])
    exact = dao.direct_form_rows(design.controller, M)
    assert dao._loss(design, exact.astype(np.float32)) > 0.01
    assert "have a factor more" in written.notes[0]
    z = np.exp(0.5j)
    ratios = []
    for column in (matrix[:, 0], exact[:, 0]):
        a = np.r_[1.0, -column[M + 1 :]]
        ratios.append(np.polyval(column[: M + 1], z) / np.polyval(a, z))
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-4)  # the factor cancels


@given(seed=st.integers(0, 2**32 - 1), orders=st.lists(st.integers(1, 5), min_size=1, max_size=3))
def test_modes_of_any_order(seed, orders):
    """Modes of different orders, some without feedthrough, some with states of no effect."""
    rng = np.random.default_rng(seed)
    blocks = []
    for order in orders:
        A = rng.standard_normal((order, order))
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
        B, C, D = (rng.standard_normal(shape) for shape in ((order, 1), (1, order), (1, 1)))
        blocks.append((A, B * rng.choice([0, 1]), C, D * rng.choice([0, 1])))
    A, B, C, D = (block_diag(*matrices) for matrices in zip(*blocks, strict=True))
    turn = rng.permutation(len(A))
    controller = lbt.Controller(A=A[np.ix_(turn, turn)], B=B[turn], C=C[:, turn], D=D)
    rows = dao.direct_form_rows(controller, 6)
    series = rng.standard_normal((100, len(orders)))
    runs = controller.start(), DifferenceEquation(rows), dao.direct_form(rows, 1.0).start()
    expected, *others = ([run.step(y) for y in series] for run in runs)
    limit = 1e-9 * max(1.0, np.max(np.abs(expected)))
    assert np.allclose(others, [expected] * 2, rtol=0, atol=limit)


def test_coefficients_of_close_poles():
    """(z - r)^8 with r = 1 - 2^-10, next to the binomials of exact numbers."""
    r, n = 1 - 2.0**-10, 8
    A = r * np.eye(n) + np.eye(n, k=1)
    C, B = np.eye(n)[:1], np.eye(n)[:, -1:]
    ((num, den),) = dao.mode_polynomials(lbt.Controller(A=A, B=B, C=C, D=[[0.0]]))
    exact = [comb(n, k) * (-1) ** k * 1023**k / 1024**k for k in range(n + 1)]
    assert den == pytest.approx(exact, abs=BALANCE * max(exact))
    assert num == pytest.approx([0.0] * (n - 1) + [1.0, 0.0], abs=BALANCE * max(exact))


@pytest.mark.parametrize("limit", [np.float32(np.inf), np.float32(0.8)])
def test_it_gives_the_commands_bit_for_bit(limit):
    rng = np.random.default_rng(1)
    matrix = (0.2 * rng.standard_normal((9, 3))).astype(np.float32)
    series = rng.standard_normal((200, 3)).astype(np.float32)
    loop, equation = dao.InnerLoop(matrix, limit=limit), DifferenceEquation(matrix, limit)
    found, expected = (np.array([run.step(y) for y in series]) for run in (loop, equation))
    assert np.array_equal(found, expected)
    assert np.any(np.abs(expected) > 0.9) != np.isfinite(limit)
    loop.reset()
    assert np.array_equal(loop.step(series[0]), expected[0])


@pytest.fixture(scope="module")
def case(shaped):
    rows = dao.direct_form_rows(shaped.controller, 20)[:, 0]
    return dao.mode_loop(shaped.hardware, shaped.specifications[0], 20), rows


def rounding_nm(loop, c):
    """What the arithmetic adds in each scenario."""
    return np.sqrt(loop.residuals_nm(c, rounding=True) ** 2 - loop.residuals_nm(c) ** 2)


def test_residuals_and_radius_are_those_of_the_design(case, shaped):
    loop, c = case
    air, line, *_ = shaped.specifications[0].terms
    expected = []
    for gain in loop.gains:
        around = lbt.close_loop(shaped.hardware, shaped.controller, sensor_gain=gain)
        truth = lbt.Truth(turbulence=air.turbulence, noise_nm=air.noise_nm, sensor_gain=gain)
        budget = lbt.residual_budget(around, truth, frame_means=True)
        peak = band_norm(around.path("phase", "residual"), line.low_hz, line.high_hz).upper
        expected.append(np.hypot(budget.rms_nm, line.rms_nm * peak))
    assert (*loop.gains, loop.low, loop.high) == (1.0, 0.6, 0.5, 1.2)
    assert loop.residuals_nm(c) == pytest.approx(expected, rel=2e-3)
    gains = np.append(np.geomspace(0.5, 1.2, 25), 1.0)
    radius = np.max(affine_radii(parts_by_gain(shaped.hardware, shaped.controller), gains))
    assert loop.radius(c) == pytest.approx(radius, rel=1e-6)


def test_sums_are_as_large_as_in_a_simulation(case):
    """White measurements into an FIR filter have known partial sums; the loop's are simulated."""
    loop, c = case
    rng, frames = np.random.default_rng(2), 40_000
    air = lfilter([40.0], [1.0, -0.99], rng.standard_normal(frames))
    line = np.sqrt(2) * 100 * np.cos(2 * np.pi * 20 / 800 * np.arange(frames))
    equation, u, residual, squares = DifferenceEquation(c[:, None]), np.zeros(1), 0.0, 0.0
    for phase, noise in zip(air + line, 20 * rng.standard_normal(frames), strict=True):
        last, u = u, equation.step(residual + noise)
        residual = phase - last
        squares += np.sum(equation.terms**2) + np.sum(np.cumsum(equation.terms)[1:] ** 2)
    expected = dao.ROUNDING * squares / frames
    assert loop.sums_nm2(c, loop.gains[0]) == pytest.approx(expected, rel=0.15)


def test_a_common_factor_leaves_the_loop_and_takes_rounding_away(case, shaped):
    """It keeps the state-space loop, through which noise enters with the command, well conditioned."""
    loop, c = case
    wide = dao._widened(c)
    assert loop.residuals_nm(wide) == pytest.approx(loop.residuals_nm(c), rel=1e-6)
    assert dao._coefficients(dao._sections(wide)) == pytest.approx(wide, abs=1e-9)
    before, after = rounding_nm(loop, c)[0], rounding_nm(loop, wide)[0]
    assert after < 0.2 * before
    added = np.concatenate([np.eye(21)[0], wide[21:]])
    written, entry = (dao.direct_form(x[:, None], shaped.controller.dt_s) for x in (wide, added))
    variance = np.array([loop.sums_nm2(wide, 1.0)])
    rounding_nm2 = _rounding_left(shaped.hardware, written, entry, variance, 1.0)
    assert after == pytest.approx(np.sqrt(rounding_nm2[0]), rel=2e-3)


def test_slopes_are_those_of_finite_differences(case):
    """Without the rounding, whose memory counts as constant."""
    loop, c = case
    loop = replace(loop, shares=np.zeros_like(loop.shares))
    theta = dao._sections(dao._widened(c))
    shares = 1 / loop.residuals_nm(c)
    limits = dao._limits(loop, c)
    before, slopes = dao._rows(loop, shares, limits, theta)
    for k in range(0, theta.size, 5):
        step = np.zeros(theta.size)
        step[k] = 1e-5
        up, down = (dao._rows(loop, shares, limits, theta + s)[0] for s in (step, -step))
        scale = np.max(np.abs(slopes[:, k]))
        smooth = (up == 0) == (down == 0)  # but for limits that are passed in between
        found, expected = (up - down)[smooth] / 2e-5, slopes[smooth, k]
        assert found == pytest.approx(expected, abs=1e-4 * scale)
        assert np.mean(smooth) > 0.999
    assert np.all(np.isfinite(before))


def test_errors_of_rounding_cancel_where_they_count(case):
    """Against rounding one by one, by what each changes of the loop's polynomial."""
    loop, own = case
    c = dao._widened(own)
    rounded = dao.round_together(loop, c)
    assert rounded.dtype == np.float32
    assert np.any(own == 0)
    assert np.all(dao.round_together(loop, own)[own == 0] == 0)

    def change(near):
        gains = (1.0, loop.low, loop.high, *loop.gains)
        pairs = [[loop.polynomials(x, gain)[2] for x in (near.astype(float), c)] for gain in gains]
        return np.linalg.norm([after / before - 1 for after, before in pairs])

    assert change(rounded) < 0.1 * change(c.astype(np.float32))
