"""Plants and problems that many tests share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[2]
LBT_YAML = ROOT / "examples" / "lbt.yaml"


def lbt_axis_plant(*, modes: int = 1, delay_frames: float = 2.0, damping: float = 0.01):
    """The LBT's numbers: 564 nm of vibration at 20 Hz, 592 nm of AR1 turbulence, 15.5 nm noise."""
    pole = 0.98860
    turbulence = lbt.models.ARModel(
        coefficients=[pole], driving_rms_nm=592 * np.sqrt(1 - pole**2), frame_rate_hz=800
    )
    vibrations = [
        lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=563.6, direction=np.eye(modes)[i])
        for i in range(modes)
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        delay_frames=delay_frames,
        turbulence=turbulence,
        vibrations=vibrations,
        noise_nm=15.5,
        modes=modes,
    )


def random_problem(rng: np.random.Generator, n: int, q: int = 1, p: int | None = None, l: int = 1):
    """A random problem with correlated noise; A may have a mild unstable mode."""
    p = n + q if p is None else p
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.5, 1.05) / max(abs(np.linalg.eigvals(A)))
    D = rng.standard_normal((q, p))
    return lbt.EstimationProblem(
        A=A,
        B=rng.standard_normal((n, p)),
        C=rng.standard_normal((q, n)),
        D=D,
        L=rng.standard_normal((l, n)),
    )


def with_own_noise(problem):
    """The same problem with its measurement noise on columns of its own."""
    n, p = problem.B.shape
    q = problem.C.shape[0]
    return lbt.EstimationProblem(
        A=problem.A,
        B=np.hstack([problem.B, np.zeros((n, q))]),
        C=problem.C,
        D=np.hstack([np.zeros((q, p)), problem.D[:, :q] + 2 * np.eye(q)]),
        L=problem.L,
    )
