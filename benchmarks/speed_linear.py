"""Cases of the synthesis engine: equations, norms, inequalities, responses."""

from __future__ import annotations

from functools import partial

import control
import numpy as np
import scipy.linalg
from harness import Row, once, paired, seconds, with_growth

import lbt_synth as lbt
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.linear.riccati.filtering import kalman_riccati

RATE_HZ = 800.0
POINTS = 10_000


def plant(vibrations: int) -> lbt.models.TipTiltPlant:
    """One axis, AR1 turbulence, some lines from 10 to 120 Hz: 2 states a line and 2 more."""
    slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=RATE_HZ)
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=100, direction=(1,))
        for f in np.linspace(10, 120, vibrations)
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE_HZ, turbulence=slow, vibrations=lines, noise_nm=15.5, modes=1
    )


def modal_bank(count: int) -> tuple[np.ndarray, ...]:
    """Filter equations of single modes: AR2 turbulence of 0.5 to 5 Hz, two frames of delay."""
    rng = np.random.default_rng(3)
    slow, damping = 2 * np.pi * rng.uniform(0.5, 5, count) / RATE_HZ, 0.14
    decay = np.exp(-damping * slow)
    A = np.zeros((count, 3, 3))
    A[:, 0, 0] = 2 * decay * np.cos(slow * np.sqrt(1 - damping**2))
    A[:, 0, 1] = -(decay**2)
    A[:, 1, 0] = A[:, 2, 0] = 1
    C, Q = np.zeros((count, 1, 3)), np.zeros((count, 3, 3))
    C[:, 0, 2] = Q[:, 0, 0] = 1
    R = (10 ** rng.uniform(0, 2, count))[:, None, None] ** 2
    return np.swapaxes(A, 1, 2), np.swapaxes(C, 1, 2), Q, R


def scipy_loop(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> None:
    """X and gain of each equation; where scipy refuses, nothing is computed."""
    for i in range(len(A)):
        try:
            X = scipy.linalg.solve_discrete_are(A[i], B[i], Q[i], R[i])
        except (np.linalg.LinAlgError, ValueError):
            continue
        np.linalg.solve(R[i] + B[i].T @ X @ B[i], B[i].T @ X @ A[i])


def modal_equations() -> dict[int, Row]:
    rows = {}
    for count in (42, 168, 672, 2688):
        bank = modal_bank(count)
        rows[count] = paired(
            lambda b=bank: lbt.solve_dare(*b), lambda b=bank: scipy_loop(*b), 5, calls=3
        )
    rows[672]["bar"] = 20
    return with_growth(rows)


def least_gamma_riccati() -> dict[int, Row]:
    """Whole designs: Kalman start, search, refinement, proof from below, certificate."""
    rows = {}
    for lines in (1, 4, 12, 20):
        p = plant(lines)
        rows[p.n_states] = {"ours_s": seconds(lambda q=p: lbt.hinf(q, route="riccati"), 7)}
    rows[26]["bar_s"] = 0.05
    return with_growth(rows)


def least_gamma_lmi() -> dict[int, Row]:
    """The eliminated, balanced inequality."""
    rows = {}
    for lines, bar_s in ((1, None), (4, None), (12, 3.0), (20, 60.0)):
        p = plant(lines)
        rows[p.n_states] = {"ours_s": once(lambda q=p: lbt.hinf(q))}
        if bar_s is not None:
            rows[p.n_states]["bar_s"] = bar_s
    return with_growth(rows)


def error_system(lines: int) -> lbt.linear.StateSpace:
    p = plant(lines)
    return p.error_system(kalman_riccati(p).gain_predictor)


def responses() -> dict[int, Row]:
    """Largest singular value at 10,000 frequencies."""
    rows = {}
    frequency = np.geomspace(0.1, RATE_HZ / 2, POINTS)
    for lines in (1, 4, 12, 20):
        G = error_system(lines)
        peer = G.to_control()
        rows[G.n_states] = paired(
            lambda g=G: spectral_norms(g.frequency_response(frequency)),
            lambda g=peer: control.singular_values_response(g, 2 * np.pi * frequency),
            9,
            calls=3,
        )
    rows[26]["bar"] = 10
    return with_growth(rows)


def shaped(functions: int) -> Row:
    """Shape one mode: turbulence, noise and vibrations in bands, under four demands."""
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    terms = [
        lbt.design.shaping.ResidualVariance(turbulence=air, noise_nm=15.5),
        *(
            lbt.design.shaping.VibrationBand(low_hz=low, high_hz=low + 3.0, rms_nm=100.0)
            for low in np.linspace(16.5, 80.0, 3)
        ),
    ]
    spec = lbt.design.shaping.Specification(
        terms=terms,
        demands=(
            lbt.design.shaping.Bound(response="rejection", at_most=1 / 0.45),
            lbt.design.shaping.LoopErrors(low=0.25, high=1.3),
            lbt.design.shaping.Bound(response="rejection", low_hz=0, high_hz=1, at_most=0.05),
            lbt.design.shaping.LoopErrors(delay_frames=0.3),
        ),
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE_HZ, modes=1)
    call = partial(lbt.design.shape, path, spec, functions=functions, states=None)
    return {"ours_s": seconds(call, 3)}


def shaping_by_functions() -> dict[int, Row]:
    rows = {n: shaped(n) for n in (30, 60, 120)}
    rows[60]["bar_s"] = 5.0
    return with_growth(rows)


SIZED = (
    ("modal filter equations in one call (scipy in a loop)", "equations", modal_equations),
    ("least gamma, Riccati, whole design", "states", least_gamma_riccati),
    ("least gamma, LMI, whole design", "states", least_gamma_lmi),
    (f"singular values at {POINTS} points (python-control)", "states", responses),
    ("shaping with 3 bands, whole design, by functions", "functions", shaping_by_functions),
)
