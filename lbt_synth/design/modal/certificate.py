"""Checks of the filters of many modes, by other means than the Riccati equation."""

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
    """What was measured of every mode, by other means than the Riccati equation."""

    def __init__(self, modes: int) -> None:
        self.radius, self.loop_radius = np.full((2, modes), np.nan)
        self.riccati, self.lyapunov, self.loop_lyapunov, self.rounding = np.full((4, modes), np.nan)
        self.estimation, self.residual = np.full((2, modes), np.nan)  # variances
        self.variance, self.gain = np.full((2, modes), np.nan)  # relative distances

    def filters(self, stack: PlantBatch, gains: FloatArray, solution: DareSolution) -> None:
        """Take the estimation errors: stability, variance against Riccati's, gain from it."""
        modes = stack.modes
        A, drive = stack.errors(gains)
        self.radius[modes] = spectral_radii(A)
        self.riccati[modes] = solution.residuals
        P, self.lyapunov[modes] = stationary_covariances(A, drive)
        lyapunov = (stack.L @ P @ transpose(stack.L))[:, 0, 0]
        riccati = (stack.L @ solution.X @ transpose(stack.L))[:, 0, 0]
        self.estimation[modes] = lyapunov
        self.variance[modes] = np.abs(lyapunov - riccati) / riccati
        seen = P @ transpose(stack.C)
        optimal = stack.A @ seen / (stack.R + stack.C @ seen)
        size = frobenius_norms(optimal)
        self.gain[modes] = frobenius_norms(gains - optimal) / np.where(size > 0, size, 1.0)

    def loops(
        self,
        modes: np.ndarray,
        radii: FloatArray,
        variances: FloatArray,
        residuals: FloatArray,
        rounding: FloatArray,
    ) -> None:
        """Take the closed loops: stability, variance of the residual."""
        self.loop_radius[modes], self.loop_lyapunov[modes] = radii, residuals
        self.residual[modes], self.rounding[modes] = variances[:, 0], rounding

    def certificate(self, *, applied: bool) -> Certificate:
        """Return the checks, each of its worst mode; one that fails names all modes that do.

        ``applied``: the loop applies the estimate itself, at once and a whole delay later.
        """
        stable = 1 - STABILITY_MARGIN
        equation = "relative, by squaring"
        checks = [
            _worst_mode_check("spectral radius of the filter", self.radius, stable, "eigenvalues"),
            _worst_mode_check(
                "spectral radius of the closed loop", self.loop_radius, stable, "eigenvalues"
            ),
            _worst_mode_check(
                "residual of the Riccati equation",
                self.riccati,
                RESIDUAL_TOLERANCE,
                "relative, in extended precision",
            ),
            _worst_mode_check(
                "residual of the Lyapunov equation", self.lyapunov, RESIDUAL_TOLERANCE, equation
            ),
            _worst_mode_check(
                "variance, against the Riccati equation",
                self.variance,
                VARIANCE_TOLERANCE,
                "relative, Lyapunov equation",
            ),
            _worst_mode_check(
                "distance from the least-variance gain",
                self.gain,
                GAIN_TOLERANCE,
                "gain recomputed from the Lyapunov covariance",
            ),
            _worst_mode_check(
                "residual of the loop's Lyapunov equation",
                self.loop_lyapunov,
                RESIDUAL_TOLERANCE,
                equation,
            ),
        ]
        if applied:  # the residual is the estimation error
            apart = np.abs(self.residual - self.estimation) / self.estimation
            checks.append(
                _worst_mode_check(
                    "residual of the closed loop, against the estimation error",
                    apart,
                    VARIANCE_TOLERANCE,
                    "relative, two Lyapunov equations",
                )
            )
        else:
            checks.append(
                _worst_mode_check(
                    "rounding in the residual of the closed loop",
                    self.rounding,
                    VARIANCE_TOLERANCE,
                    "relative, sizes of the terms of its variance",
                )
            )
        return Certificate(
            checks=tuple(checks),
            gamma=np.nan,
            rms_per_output=frozen_copy(np.sqrt(np.maximum(self.estimation, 0))),
        )


def _worst_mode_check(name: str, values: FloatArray, limit: float, computed_by: str) -> Check:
    """Check of the worst of all modes."""
    failing = np.flatnonzero(~(values < limit))
    value = float(np.max(values)) if not np.isnan(values).any() else float("nan")
    if failing.size:
        name = f"{name} ({name_modes(failing)})"
    return Check(name=name, value=value, limit=limit, computed_by=computed_by)
