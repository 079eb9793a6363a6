"""The certificate of the filters of many modes, by other means than the Riccati equation."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    RESIDUAL_TOLERANCE,
    VARIANCE_TOLERANCE,
    Certificate,
    Check,
)
from lbt_synth.design.modal.closed_loops import spectral_radii
from lbt_synth.design.modal.plants import PlantBatch
from lbt_synth.design.modal.reconstructor import name_modes
from lbt_synth.linear import DareSolution
from lbt_synth.linear.batched import frobenius_norms, transpose
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.validation import FloatArray, frozen_copy


class ModalChecks:
    """Stability, variances and gains of every mode, as numbers to be checked."""

    def __init__(self, modes: int) -> None:
        self.radius, self.loop_radius = np.full((2, modes), np.nan)
        self.riccati, self.lyapunov, self.loop_lyapunov, self.rounding = np.full((4, modes), np.nan)
        self.estimation, self.residual = np.full((2, modes), np.nan)  # as variances
        self.variance, self.gain = np.full((2, modes), np.nan)  # relative differences

    def add_filters(self, batch: PlantBatch, gains: FloatArray, solution: DareSolution) -> None:
        """Add the errors of some filters: stability, variance against Riccati's, gain from it."""
        modes = batch.modes
        A, drive = batch.error_systems(gains)
        self.radius[modes] = spectral_radii(A)
        self.riccati[modes] = solution.residuals
        P, self.lyapunov[modes] = stationary_covariances(A, drive)
        lyapunov = (batch.L @ P @ transpose(batch.L))[:, 0, 0]
        riccati = (batch.L @ solution.X @ transpose(batch.L))[:, 0, 0]
        self.estimation[modes] = lyapunov
        self.variance[modes] = np.abs(lyapunov - riccati) / riccati
        seen = P @ transpose(batch.C)
        optimal = batch.A @ seen / (batch.R + batch.C @ seen)
        size = frobenius_norms(optimal)
        self.gain[modes] = frobenius_norms(gains - optimal) / np.where(size > 0, size, 1.0)

    def add_loops(
        self,
        modes: np.ndarray,
        radii: FloatArray,
        variances: FloatArray,
        residuals: FloatArray,
        rounding: FloatArray,
    ) -> None:
        """Add the closed loops of some modes: stability, variance of the residual."""
        self.loop_radius[modes], self.loop_lyapunov[modes] = radii, residuals
        self.residual[modes], self.rounding[modes] = variances[:, 0], rounding

    def certificate(self, *, applied: bool) -> Certificate:
        """Check the worst mode of everything; a check that fails names all modes that do.

        ``applied``: the loop applies the estimate itself, at once and a whole delay later.
        """
        stable = 1 - STABILITY_MARGIN
        equation = "relative, by squaring"
        rows = [
            ("spectral radius of the filter", self.radius, stable, "eigenvalues"),
            ("spectral radius of the closed loop", self.loop_radius, stable, "eigenvalues"),
            (
                "residual of the Riccati equation",
                self.riccati,
                RESIDUAL_TOLERANCE,
                "relative, in extended precision",
            ),
            ("residual of the Lyapunov equation", self.lyapunov, RESIDUAL_TOLERANCE, equation),
            (
                "variance, against the Riccati equation",
                self.variance,
                VARIANCE_TOLERANCE,
                "relative, Lyapunov equation",
            ),
            (
                "distance from the least-variance gain",
                self.gain,
                GAIN_TOLERANCE,
                "gain recomputed from the Lyapunov covariance",
            ),
            (
                "residual of the loop's Lyapunov equation",
                self.loop_lyapunov,
                RESIDUAL_TOLERANCE,
                equation,
            ),
            (  # the residual is the estimation error
                "residual of the closed loop, against the estimation error",
                np.abs(self.residual - self.estimation) / self.estimation,
                VARIANCE_TOLERANCE,
                "relative, two Lyapunov equations",
            )
            if applied
            else (
                "rounding in the residual of the closed loop",
                self.rounding,
                VARIANCE_TOLERANCE,
                "relative, sizes of the terms of its variance",
            ),
        ]
        return Certificate(
            checks=tuple(_worst_mode_check(*row) for row in rows),
            gamma=np.nan,
            rms_per_output=frozen_copy(np.sqrt(np.maximum(self.estimation, 0))),
        )


def _worst_mode_check(name: str, values: FloatArray, limit: float, computed_by: str) -> Check:
    """Check the worst of all modes."""
    failing = np.flatnonzero(~(values < limit))
    value = float(np.max(values)) if not np.isnan(values).any() else float("nan")
    if failing.size:
        name = f"{name} ({name_modes(failing)})"
    return Check(name=name, value=value, limit=limit, computed_by=computed_by)
