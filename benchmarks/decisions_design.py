"""How the routes to a filter compare: run with ``python benchmarks/decisions_design.py``."""

import time
import warnings

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_are

import lbt_synth as lbt
from lbt_synth.errors import LbtSynthError
from lbt_synth.linear.lmi.filters import balance, hinf_lmi, kalman_sdp, least_gamma_lmi
from lbt_synth.linear.lmi.programmes import solve
from lbt_synth.linear.riccati.filtering import gamma_riccati, kalman_riccati

RATE_HZ = 800.0
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)


def plant(damping: float, *, order: int, lines: int) -> lbt.models.TipTiltPlant:
    """One axis with lines at 20, 33, 46, ... Hz."""
    turbulence = (
        lbt.models.ar1_turbulence(AIR, frame_rate_hz=RATE_HZ)
        if order == 1
        else lbt.models.ar2_turbulence(AIR, frame_rate_hz=RATE_HZ, noise_nm=15.5)
    )
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE_HZ,
        turbulence=turbulence,
        noise_nm=15.5,
        modes=1,
        vibrations=[
            lbt.Vibration(frequency_hz=20 + 13 * i, damping=damping, rms_nm=100.0, direction=(1,))
            for i in range(lines)
        ],
    )


def riccati_routes() -> None:
    """Doubling against the Schur method on plants of growing stiffness."""
    total = schur_failed = doubling_failed = 0
    worst = 0.0
    for damping in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        for order in (1, 2):
            for lines in (1, 2, 4):
                p = plant(damping, order=order, lines=lines)
                total += 1
                try:
                    worst = max(worst, kalman_riccati(p).residual)
                except LbtSynthError:
                    doubling_failed += 1
                try:
                    solve_discrete_are(p.A.T, p.C.T, p.Q, p.R)
                except (np.linalg.LinAlgError, ValueError):
                    schur_failed += 1
    print(
        f"Riccati: {total} plants; failures: ours {doubling_failed}, Schur {schur_failed}; "
        f"our worst relative residual {worst:.1e}"
    )


def coordinates() -> None:
    """The semidefinite programme of the Kalman filter, balanced and not."""
    for lines in (1, 2, 4):
        p = plant(5e-3, order=2, lines=lines)
        exact = kalman_riccati(p)
        for name, basis in (("balanced", exact.P), ("raw", np.eye(len(p.A)))):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found = kalman_sdp(p, coordinates=basis, scale=1.0)
                error = np.linalg.norm(found.gain_predictor - exact.gain_predictor)
                error /= np.linalg.norm(exact.gain_predictor)
                print(
                    f"SDP, {len(p.A):2d} states, {name:8s}: {found.status}, gain off by {error:.1e}"
                )
            except LbtSynthError as failure:
                print(f"SDP, {len(p.A):2d} states, {name:8s}: {failure}"[:100])


def whole_lmi(p: lbt.EstimationProblem) -> tuple[str, float]:
    """Least gamma by the inequality that keeps Y = P K as a variable."""
    n, q, w, out = len(p.A), len(p.C), p.B.shape[1], len(p.L)
    P = cp.Variable((n, n), symmetric=True)
    Y = cp.Variable((n, q))
    level = cp.Variable()
    error, drive = P @ p.A - Y @ p.C, P @ p.B - Y @ p.D
    zero = np.zeros
    block = cp.bmat(
        [
            [P, zero((n, w)), error.T, p.L.T],
            [zero((w, n)), level * np.eye(w), drive.T, zero((w, out))],
            [error, drive, P, zero((n, out))],
            [p.L, zero((out, w)), zero((out, n)), np.eye(out)],
        ]
    )
    status, _ = solve(cp.Minimize(level), [(block + block.T) / 2 >> 0])
    return status, float(np.sqrt(level.value))


def eliminated() -> None:
    """The least gamma with and without the gain among the unknowns."""
    for lines in (1, 2, 4, 8, 11):
        p = plant(5e-3, order=2, lines=lines)
        start = kalman_riccati(p)
        scale = float(np.sqrt(p.L @ start.P @ p.L.T)[0, 0])
        truth = lbt.hinf(p, route="riccati").gamma_requested
        began = time.perf_counter()
        ours, _ = least_gamma_lmi(p, coordinates=start.P, scale=scale)
        middle = time.perf_counter()
        reached = lbt.hinf_norm(p.error_system(ours.gain_predictor)).upper
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            status, gamma = whole_lmi(balance(p, start.P, scale).problem)
        end = time.perf_counter()
        print(
            f"LMI, {len(p.A):2d} states: eliminated {middle - began:.2f} s, gamma off by "
            f"{reached / truth - 1:+.1e} ({ours.status}); whole {end - middle:.2f} s, "
            f"{gamma * scale / truth - 1:+.1e} ({status})"
        )


def agreement() -> None:
    """The central filter by the LMI and by the Riccati equation."""
    for ratio in (1.05, 1.2, 1.5):
        p = plant(5e-3, order=1, lines=1)
        start = kalman_riccati(p)
        level = ratio * lbt.hinf(p, route="riccati").gamma_requested
        by_riccati = gamma_riccati(p, level).gain_predictor
        by_lmi = hinf_lmi(p, level, coordinates=start.P, scale=level).gain_predictor
        error = np.linalg.norm(by_lmi - by_riccati) / np.linalg.norm(by_riccati)
        print(f"central filter at {ratio} least gamma: gains differ by {error:.1e}")


if __name__ == "__main__":
    riccati_routes()
    coordinates()
    eliminated()
    agreement()
