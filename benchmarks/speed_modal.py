"""Cases of modal control: hundreds of modes at once."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from harness import Row, paired, seconds, with_growth

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, ModalFilters, modal_filters, modal_residuals

RATE_HZ = 800.0
NOISE_NM = 10.0


def turbulence(modes: int, order: int = 1) -> lbt.models.ModalTurbulence:
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    ar1 = lbt.models.modal_turbulence(air, modes=modes, frame_rate_hz=RATE_HZ)
    if order == 1:
        return ar1
    # resonances of the same cut-off, so that there are more states
    turns = -np.log(ar1.coefficients[:, 0])
    decay = np.exp(-0.4 * turns)
    return lbt.models.ModalTurbulence(
        coefficients=np.stack([2 * decay * np.cos(0.9 * turns), -(decay**2)], axis=1),
        driving_rms_nm=ar1.driving_rms_nm * turns,
        frame_rate_hz=RATE_HZ,
    )


def controllers(modes: int, kind: str) -> MixedController | ModalFilters:
    """Integrators (1 state), Kalman filters of AR1 turbulence, of AR2, of AR2 and a line."""
    if kind == "integrator":
        return MixedController(gains=np.full(modes, 0.4))
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=30.0)
    return modal_filters(
        turbulence(modes, 1 if kind == "AR1" else 2),
        noise_nm=NOISE_NM,
        vibrations=dict.fromkeys(range(modes), line) if kind == "line" else None,
    )


def residuals() -> dict[int, Row]:
    """Exact residuals of all modes in the image, each with a filter of its own."""
    rows = {}
    for count in (42, 168, 672):
        air, filters = turbulence(count), controllers(count, "AR1")
        rows[count] = {
            "ours_s": seconds(lambda a=air, f=filters: modal_residuals(f, a, noise_nm=NOISE_NM), 5)
        }
    return with_growth(rows)


def designs() -> dict[int, Row]:
    """Certified filters of all modes, equal ones once; the peer solves the equation of each."""
    rows = {}
    for count in (42, 168, 672, 2688):
        air = turbulence(count)
        filters = modal_filters(air, noise_nm=NOISE_NM)
        plants = [filters.design(i).problem for i in range(count)]
        equations = [(plant.A, plant.C, plant.Q, plant.R) for plant in plants]

        def peer(equations=equations) -> None:
            for A, C, Q, R in equations:
                X = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
                np.linalg.solve(R + C @ X @ C.T, C @ X @ A.T)

        rows[count] = paired(lambda a=air: modal_filters(a, noise_nm=NOISE_NM), peer, 5, calls=3)
    return with_growth(rows)


def gains() -> dict[int, Row]:
    rows = {}
    for count in (42, 168, 672):
        air = turbulence(count)
        rows[count] = {
            "ours_s": seconds(
                lambda a=air: lbt.design.modal.modal_gains(
                    a, noise_nm=NOISE_NM, frame_rate_hz=RATE_HZ
                ),
                5,
            )
        }
    return with_growth(rows)


def steps() -> dict[int, Row]:
    """A thousand steps of a mixed controller; the peer is a product with a reconstructor."""
    tilts = turbulence(2)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE_HZ,
        turbulence=[tilts.model(0), tilts.model(1)],
        noise_nm=NOISE_NM,
    )
    rows = {}
    for count in (42, 168, 672):
        mixed = MixedController(filter=lbt.kalman(plant), gains=np.full(count, 0.4))
        y, slopes = np.ones(count), np.ones(2 * count)
        inverse = np.ones((count, 2 * count))
        rows[count] = paired(
            lambda m=mixed, y=y: [m.step(y) for _ in range(1000)],
            lambda r=inverse, s=slopes: [r @ s for _ in range(1000)],
            5,
        )
    return with_growth(rows)


MODAL = (
    ("residuals of all modes in the image", "modes", residuals),
    ("filters of all modes, whole design (scipy, equations alone)", "modes", designs),
    ("integrator gains of all modes, from spectra", "modes", gains),
    ("1000 steps of a mixed controller (a reconstructor's product)", "modes", steps),
)
