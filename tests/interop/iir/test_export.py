"""Transfer-function files, stepped and refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from math import comb

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.exports import bare_design, relative, transfer_functions
from support.plants import LBT_YAML, ROOT
from support.specula_filters import noise_series, simulate_commands

import lbt_synth as lbt
from lbt_synth.interop.iir.export import axis_polynomials


@pytest.mark.parametrize(("name", "limit"), [("kalman", 1e-12), ("hinf", 1e-9), ("integrator", 0)])
def test_transfer_functions_are_those_of_the_controller(tmp_path, designs, name, limit):
    design = designs[name]
    written = lbt.interop.export_iir(tmp_path / "k.fits", design)
    num, den = transfer_functions(written.files[0])
    assert written.error <= max(limit, 1e-15)
    frequency = np.linspace(0.5, 399, 200)
    z = np.exp(2j * np.pi * frequency * design.controller.dt_s)
    expected = design.controller.to_statespace().frequency_response(frequency)
    for axis in range(2):
        found = np.polyval(num[axis, ::-1], z) / np.polyval(den[axis, ::-1], z)
        assert relative(found, expected[:, axis, axis]) < 1e-9


def test_an_integrator_is_the_textbook_one(tmp_path, loaded):
    slow = lbt.integrator(loaded.hardware, gain=0.25)
    num, den = transfer_functions(lbt.interop.export_iir(tmp_path / "k.fits", slow).files[0])
    assert num.tolist() == [[0, 0.25]] * 2  # 0.25 z / (z - 1)
    assert den.tolist() == [[-1, 1]] * 2


def test_states_of_the_other_axis_and_delays_in_both_are_left_out(tmp_path, designs):
    num, den = transfer_functions(
        lbt.interop.export_iir(tmp_path / "k.fits", designs["kalman"]).files[0]
    )
    assert num.shape == (2, 5)  # of ten states, five are the other axis', one a factor z
    poles = np.sort_complex(np.roots(den[0, ::-1]))
    own = np.linalg.eigvals(designs["kalman"].controller.A)
    assert all(np.min(np.abs(own - pole)) < 1e-9 for pole in poles)


@pytest.mark.usefixtures("short_rehearsal")
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), orders=st.lists(st.integers(1, 5), min_size=1, max_size=3))
def test_axes_of_any_order(tmp_path, seed, orders):
    """Axes of different orders, some without feedthrough, some with states of no effect."""
    rng = np.random.default_rng(seed)
    n, m = sum(orders), len(orders)
    A, B, C, D = np.zeros((n, n)), np.zeros((n, m)), np.zeros((m, n)), np.zeros((m, m))
    start = 0
    for axis, order in enumerate(orders):
        own = slice(start, start + order)
        start += order
        block = rng.standard_normal((order, order))
        A[own, own] = block * (0.9 / np.max(np.abs(np.linalg.eigvals(block))))
        B[own, axis] = rng.standard_normal(order) * rng.choice([0, 1])
        C[axis, own] = rng.standard_normal(order)
        D[axis, axis] = rng.standard_normal() * rng.choice([0, 1])
    turn = rng.permutation(n)
    controller = lbt.Controller(A=A[np.ix_(turn, turn)], B=B[turn], C=C[:, turn], D=D)
    written = lbt.interop.export_iir(tmp_path / "k.fits", bare_design(controller))
    num, den = transfer_functions(written.files[0])
    series = rng.standard_normal((100, m))
    run = controller.start()
    expected = np.array([run.step(y) for y in series])
    k = num.shape[1]
    y, u = np.zeros((100 + k, m)), np.zeros((100 + k, m))
    y[k:] = series
    for t in range(k, 100 + k):  # the difference equation, word for word
        past = slice(t - k + 1, t + 1)
        u[t] = np.sum(num.T * y[past], axis=0) - np.sum(den.T[:-1] * u[past][:-1], axis=0)
    assert np.max(np.abs(u[k:] - expected)) < 1e-9 * max(1.0, np.max(np.abs(expected)))


def test_transfer_functions_that_do_not_hold(tmp_path, loaded, designs):
    """Fifteen lines within a few hertz: no double precision coefficients hold these poles."""
    with pytest.raises(lbt.errors.NumericalError, match="do not hold the poles") as caught:
        lbt.interop.export_iir(tmp_path / "k.fits", designs["prior"])
    assert caught.value.residual > 1e-6
    with pytest.raises(lbt.errors.NumericalError, match="to 1e-30 of the largest one"):
        lbt.interop.export_iir(tmp_path / "k.fits", designs["kalman"], tolerance=1e-30)
    assert not list(tmp_path.iterdir())


def test_single_precision_may_break_a_loop(tmp_path, loaded):
    """Three lines: fine in double precision, unstable in single, and it is said."""
    prior = lbt.kalman(lbt.models.spread_plant(loaded.plant, half_width_hz=3.5, lines=3))
    written = lbt.interop.export_iir(tmp_path / "k.fits", prior)
    assert written.error < 1e-6
    assert written.error_single > 1e-2


def test_the_loop_is_proved_in_the_precision_that_runs_it(tmp_path, loaded, designs):
    written = lbt.interop.export_iir(tmp_path / "k.fits", designs["kalman"], precision="single")
    losses = [check.value for check in written.checks if check.name.startswith("residual")]
    assert 1e-9 < max(losses) < 1e-4
    beside = json.loads(written.files[1].read_text())
    assert (beside["precision"], beside["specula_precision"]) == ("single", 1)
    prior = lbt.kalman(lbt.models.spread_plant(loaded.plant, half_width_hz=1.0, lines=3))
    with pytest.raises(lbt.errors.NumericalError, match="in single precision, as a transfer"):
        lbt.interop.export_iir(tmp_path / "no.fits", prior, precision="single")
    assert not list(tmp_path.glob("no*"))


def test_axes_that_do_not_decouple(tmp_path, loaded):
    slanted = replace(loaded.plant.vibrations[0], direction=(0.6, 0.8))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=loaded.plant.turbulence,
        vibrations=[slanted],
        noise_nm=loaded.noise_nm,
    )
    with pytest.raises(lbt.errors.ProblemError, match="here measurement 2 moves command 1"):
        lbt.interop.export_iir(tmp_path / "k.fits", lbt.kalman(plant))
    direct = lbt.Controller(A=[[0.0]], B=[[0.0, 0.0]], C=[[0.0], [0.0]], D=[[1.0, 0.0], [0.5, 1.0]])
    with pytest.raises(lbt.errors.ProblemError, match="here measurement 1 moves command 2"):
        lbt.interop.export_iir(tmp_path / "k.fits", bare_design(direct))
    wide = lbt.Controller(A=[[0.5]], B=[[1.0, 2.0]], C=[[1.0]], D=[[0.0, 0.0]])
    with pytest.raises(lbt.errors.ProblemError, match="got 1 commands and 2 measurements"):
        lbt.interop.export_iir(tmp_path / "k.fits", bare_design(wide))
    long = lbt.Controller(A=np.eye(41, k=1), B=np.eye(41)[:, -1:], C=np.eye(41)[:1], D=[[0.0]])
    with pytest.raises(
        lbt.errors.ProblemError, match="at most 40 states for a transfer function; got 41"
    ):
        lbt.interop.export_iir(tmp_path / "k.fits", bare_design(long))
    big = lbt.Controller(A=1e150 * np.eye(2, k=1), B=[[0.0], [1e150]], C=[[1e150, 0.0]], D=[[0.0]])
    with pytest.raises(lbt.errors.NumericalError, match="too large for double precision"):
        lbt.interop.export_iir(tmp_path / "k.fits", bare_design(big))
    with pytest.raises(lbt.errors.ProblemError, match="tolerance must be above 0"):
        lbt.interop.export_iir(tmp_path / "k.fits", bare_design(long), tolerance=0)
    assert not list(tmp_path.iterdir())


DOUBLE, SINGLE = 0, 1


SCRIPT = ROOT / "tests" / "support" / "specula_filters.py"


@pytest.fixture(scope="module")
def simulated_designs():
    loaded = lbt.load_config(LBT_YAML)
    return {
        "kalman": lbt.kalman(loaded.plant),
        "hinf": lbt.hinf(loaded.plant, gamma_ratio=1.2),
        "integrator": lbt.design.optimal_integrator(loaded.hardware, loaded.truth),
    }


@pytest.fixture(scope="module")
def filter_files(simulated_designs, tmp_path_factory):
    """The gain file as it is, and the exported transfer functions."""
    folder = tmp_path_factory.mktemp("specula")
    made = {}
    for name, design in simulated_designs.items():
        made[name, "ssr"] = lbt.save_gain(folder / f"{name}.fits", design)
        made[name, "iir"] = lbt.interop.export_iir(folder / f"{name}_iir.fits", design).files[0]
    return made


@pytest.fixture(scope="module", params=[DOUBLE, SINGLE], ids=["double", "single"])
def specula_run(request, filter_files, tmp_path_factory):
    """Commands of each file in SPECULA, in the closed loop and on given measurements."""
    output = tmp_path_factory.mktemp("run") / "commands.npz"
    named = [f"{kind}:{file}" for (_, kind), file in filter_files.items()]
    done = subprocess.run(
        [sys.executable, SCRIPT, str(request.param), output, LBT_YAML, *named],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(output) as data:
        series = {key: (data[f"loop{i}"], data[f"noise{i}"]) for i, key in enumerate(filter_files)}
    return request.param, series


# what the loop of each file is held to, in double and in single precision; the state-space
# file has the controller's own numbers. The LMI leaves couplings of 1e-11 between the axes,
# which one transfer function an axis cannot have.
LIMITS = {
    ("kalman", "ssr"): (1e-12, 1e-5),
    ("hinf", "ssr"): (1e-12, 1e-5),
    ("integrator", "ssr"): (1e-12, 1e-5),
    ("kalman", "iir"): (1e-12, 1e-5),
    ("hinf", "iir"): (1e-10, 1e-5),
    ("integrator", "iir"): (1e-12, 1e-5),
}


@pytest.mark.e2e
@pytest.mark.parametrize("key", LIMITS, ids="-".join)
def test_the_closed_loop_is_that_of_our_simulator(simulated_designs, specula_run, key):
    """Same disturbance and noise: SPECULA's filter in the loop, and our simulator."""
    precision, series = specula_run
    expected = simulate_commands(simulated_designs[key[0]].controller, LBT_YAML)
    assert np.max(np.abs(expected)) > 100  # nm: there is something to correct
    assert relative(series[key][0], expected) < LIMITS[key][precision]


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_same_measurements_give_the_same_commands(simulated_designs, specula_run, name):
    """The gain file untouched, against the stepped controller, on measurements of no loop."""
    precision, series = specula_run
    ours = simulated_designs[name].controller.start()
    expected = np.array([ours.step(y) for y in noise_series(2)])
    assert relative(series[name, "ssr"][1], expected) < (1e-12, 1e-5)[precision]


@pytest.mark.e2e
def test_the_stated_error_of_a_transfer_function_is_what_specula_finds(
    simulated_designs, specula_run, tmp_path
):
    """Within a factor of ten: the disturbances of the two runs are not the same."""
    precision, series = specula_run
    loop = series["kalman", "iir"][0]
    stated = lbt.interop.export_iir(tmp_path / "again.fits", simulated_designs["kalman"])
    own = series["kalman", "ssr"][0]
    found = relative(loop, own)
    claimed = (stated.error, stated.error_single)[precision]
    assert claimed / 10 < found < 10 * claimed


def test_exact_coefficients_of_close_poles():
    """(z - r)^8 with r = 1 - 2^-10: binomials, where floating-point routes lose half the digits."""
    r, n = 1 - 2.0**-10, 8
    A = r * np.eye(n) + np.eye(n, k=1)
    C, B = np.eye(n)[:1], np.eye(n)[:, -1:]
    ((num, den),) = axis_polynomials(lbt.Controller(A=A, B=B, C=C, D=[[0.0]]))
    exact = [
        comb(n, k) * (-1) ** (n - k) * (1023 ** (n - k)) / 1024 ** (n - k) for k in range(n + 1)
    ]
    assert den.tolist() == exact
    assert num.tolist() == [0, 1] + [0] * (n - 1)
