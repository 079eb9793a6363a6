"""A Kalman filter for every mode: every different mode is designed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.certificate import VARIANCE_TOLERANCE, Check
from lbt_synth.design.filter_design import FilterDesign
from lbt_synth.design.kalman import kalman
from lbt_synth.design.modal.per_mode import (
    Vibrations,
    lines_per_mode,
    name_modes,
    number_per_mode,
)
from lbt_synth.design.modal.residuals import modal_residuals
from lbt_synth.design.modal.stack import ModalFilters
from lbt_synth.design.result import UNCERTIFIED
from lbt_synth.errors import LbtSynthError
from lbt_synth.loop import residual_budget
from lbt_synth.models import ARModel, ModalTurbulence, PositionLoop, TipTiltPlant, tip_tilt_plant
from lbt_synth.validation import FloatArray, frozen_copy, read_only

_JOINED = "residual of each mode's loop, against that of its design"


def modal_filters(
    turbulence: ModalTurbulence | Sequence[ARModel],
    *,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    delay_frames: float = 2.0,
    sensor_gain: ArrayLike = 1.0,
    mirror: PositionLoop | None = None,
) -> ModalFilters:
    """Design a Kalman filter for every mode.

    Each mode is the plant of :func:`tip_tilt_plant` for a single mode, and its filter that of
    :func:`kalman`; modes with the same numbers share a design. Modes are independent: neither
    their turbulence nor their noise is correlated.

    A mirror with dynamics is treated as :func:`kalman` does: what it really did is taken out of
    the measurements, so that every loop is stable, but the command is the estimate itself, as if
    the mirror were there at once; ``rms_nm`` holds the lag that this leaves. :func:`lqg`
    designs commands that lead the mirror, one or two modes at a time.

    Parameters
    ----------
    turbulence : ModalTurbulence or sequence of ARModel
        Turbulence of each mode.
    noise_nm : float or (n,) array_like
        Standard deviation of the measurement noise of each mode per frame [nm].
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    delay_frames : float, optional
        Total delay of the loop [frames], at least 1, fractions allowed.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain that the design assumes.
    mirror : PositionLoop, optional
        Dynamics of the mirror, the same for all modes; one that settles at once by default.

    Returns
    -------
    ModalFilters
        Certified designs, and the one of each mode.

    Raises
    ------
    ProblemError
        If a value is not finite, out of range, or sizes clash.
    NumericalError
        If an equation was not solved; the message names the modes.
    CertificateError
        If a design does not pass its checks; the message names the modes.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.9886], [0.98]], driving_rms_nm=[89.1, 20.0], frame_rate_hz=800
    ... )
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> filters = lbt.design.modal.modal_filters(air, noise_nm=15.5, vibrations={0: [line]})
    >>> filters.rms_nm.round(1).tolist(), filters.design(1).certificate.passed
    ([142.5, 31.6], True)
    """
    if not isinstance(turbulence, ModalTurbulence):
        turbulence = ModalTurbulence.of(turbulence)
    n = turbulence.n_modes
    noise = number_per_mode(noise_nm, "noise_nm", n)
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    lines = lines_per_mode(vibrations, n)
    numbers = np.column_stack([turbulence.coefficients, turbulence.driving_rms_nm, noise, gain])
    alike: dict[tuple[object, ...], list[int]] = {}  # modes with the same numbers
    for mode, row in enumerate(numbers):
        each = ((line.frequency_hz, line.damping, line.rms_nm) for line in lines[mode])
        alike.setdefault((row.tobytes(), *each), []).append(mode)
    designs: list[FilterDesign] = []
    which, rms_nm = np.zeros(n, dtype=np.int64), np.zeros(n)
    for modes in alike.values():
        first = modes[0]
        plant = tip_tilt_plant(
            frame_rate_hz=turbulence.frame_rate_hz,
            turbulence=turbulence.model(first),
            vibrations=lines[first] or None,
            noise_nm=float(noise[first]),
            delay_frames=delay_frames,
            sensor_gain=float(gain[first]),
            modes=1,
            mirror=mirror,
        )
        design = _design_filter(plant, modes)
        which[modes] = len(designs)
        rms_nm[modes] = residual_budget(design.close(plant.hardware), plant).rms_nm
        designs.append(design)
    filters = ModalFilters(
        designs=tuple(designs),
        which=read_only(which),
        rms_nm=read_only(rms_nm),
        certificate=UNCERTIFIED,
    )
    left = modal_residuals(
        filters, turbulence, noise_nm=noise, vibrations=vibrations, sensor_gain=gain
    )
    errors = frozen_copy(np.array([design.rms for design in designs])[which])
    joined = replace(UNCERTIFIED, checks=(joining_check(left, rms_nm),), rms_per_output=errors)
    return replace(filters, certificate=joined.require("Scale these modes to sizes that occur."))


def _design_filter(plant: TipTiltPlant, modes: list[int]) -> FilterDesign:
    """Design the filter of a mode; an error names all modes that it is for."""
    try:
        return kalman(plant)
    except LbtSynthError as error:
        error.args = (f"the filter of {name_modes(modes)}: {error}",)
        raise


def joining_check(stacked: FloatArray, alone: FloatArray) -> Check:
    """Check the residuals (n,) of the loops of all modes against those of their designs."""
    apart = np.abs((stacked / alone) ** 2 - 1)
    failing = np.flatnonzero(~(apart < VARIANCE_TOLERANCE))
    name = f"{_JOINED} ({name_modes(failing)})" if failing.size else _JOINED
    how = "relative variance, loops as arrays and one by one"
    return Check(name, float(np.max(apart)), VARIANCE_TOLERANCE, how)
