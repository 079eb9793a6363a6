"""Plants and problems that many tests share."""

from pathlib import Path

import numpy as np

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[2]
LBT_YAML = ROOT / "examples" / "lbt.yaml"


def lbt_axis_plant(*, modes=1, delay_frames=2.0, damping=0.01):
    """The LBT's numbers: 564 nm of vibration at 20 Hz, 592 nm of AR1 turbulence, 15.5 nm noise."""
    pole = 0.98860
    turbulence = lbt.models.ARModel(
        coefficients=[pole], driving_rms_nm=592 * np.sqrt(1 - pole**2), frame_rate_hz=800
    )
    vibrations = [
        lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=563.6, direction=direction)
        for direction in np.eye(modes)
    ]
    models = {"turbulence": turbulence, "vibrations": vibrations, "noise_nm": 15.5, "modes": modes}
    return lbt.tip_tilt_plant(frame_rate_hz=800, delay_frames=delay_frames, **models)


def random_problem(rng, n, q=1, l=1):
    """A random problem with correlated noise; A may have a mild unstable mode."""
    A, p = rng.standard_normal((n, n)), n + q
    A *= rng.uniform(0.5, 1.05) / max(abs(np.linalg.eigvals(A)))
    D = rng.standard_normal((q, p))
    B, C, L = (rng.standard_normal(shape) for shape in ((n, p), (q, n), (l, n)))
    return lbt.EstimationProblem(A=A, B=B, C=C, D=D, L=L)
