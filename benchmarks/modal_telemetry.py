"""Gains and residuals that telemetry of weak turbulence behind noise gives, against the exact ones.

AR1 turbulence, pole 0.9999, driving noise 1 nm, 800 Hz, two frames, measurement noise 15.5 nm.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

import lbt_synth as lbt

MODES, RATE_HZ, NOISE_NM, POLE, SETTLE = 60, 800.0, 15.5, 0.9999, 30_000


def main() -> None:
    """Print one row a record length."""
    rng = np.random.default_rng(5)
    air = lbt.models.ModalTurbulence(
        coefficients=[[POLE]], driving_rms_nm=[1.0], frame_rate_hz=RATE_HZ
    )
    exact = lbt.design.modal.modal_gains(air, noise_nm=NOISE_NM, frame_rate_hz=RATE_HZ)
    print(f"exact: gain {exact.gains[0]:.4f}, {exact.rms_nm[0]:.2f} nm")
    print("| frames | gain | rms_nm, noise given | rms_nm, noise found |\n|---:|---:|---:|---:|")
    integrator = lbt.integrator(exact.hardware, gain=0.1)
    for frames in (2048, 8192, 40_000):
        white = rng.standard_normal((MODES, frames + SETTLE))
        total = lfilter([1.0], [1.0, -POLE], white, axis=1)[:, SETTLE:]
        noise_nm = NOISE_NM * rng.standard_normal(total.shape)
        series = lbt.loop.Disturbance(phase_nm=total[..., None], noise=noise_nm[..., None])
        run = lbt.simulate(integrator, series, hardware=exact.hardware)  # a case a mode
        cells = []
        for noise in (NOISE_NM, None):
            found = lbt.design.modal.modal_gains_from_telemetry(
                run.measurements[..., 0].T,
                run.commands[..., 0].T,
                frame_rate_hz=RATE_HZ,
                noise_nm=noise,
            )
            if not cells:
                cells.append(f"{found.gains.mean():.4f} ± {found.gains.std():.4f}")
            cells.append(f"{found.rms_nm.mean():.2f} ± {found.rms_nm.std():.2f}")
        print(f"| {frames} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
