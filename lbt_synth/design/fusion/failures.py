"""What a failed sensor does to a loop: the filter as it is, and the filter of the others.

A sensor that is known to have failed is not read, and the filter of the remaining sensors takes
over; its state is the same, so that nothing jumps. A sensor that fails unseen goes on giving
readings that do not follow the phase: zeros, or its last one. As far as stability goes these two
are one case.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.riccati.filtering import FilterRiccati, kalman_riccati
from lbt_synth.loop.fusion.fused_loop import (
    FusedLoop,
    close_fused_loop,
    fused_model_budget,
    model_readings,
)
from lbt_synth.models.fusion.plant import FusedPlant
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, frozen_copy

MOST_UNITS = 6  # sensors and channels of which every subset gets a filter


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fallback:
    """The filter of the sensors that remain when some have failed."""

    missing: tuple[str, ...]  # sensors and channels that are not read
    gains: FloatArray  # (N, n, q): predictor gains, zero for what is missing


@table_row
class FailureRow:
    """A loop in which some sensors have failed."""

    missing: str = column("sensors that fail")
    unseen_radius: float = column("radius, unseen", format=".6f")
    zero_nm: float | None = nm_column("residual, zeros", unit="nm rms", format=".1f")
    frozen_nm: float | None = nm_column("residual, frozen", unit="nm rms", format=".1f")
    fallback_radius: float = column("radius, not read", format=".6f")
    fallback_nm: float = nm_column("residual, not read", unit="nm rms", format=".1f")
    must_switch: bool = column("must be seen")


def failure_sets(units: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return every set of sensors and channels that may fail together, small ones first."""
    if len(units) > MOST_UNITS:
        raise ProblemError(
            f"a design has a fall-back filter for every set of failed sensors and channels, of "
            f"which there may be {MOST_UNITS}; got {len(units)}: {', '.join(units)}. Leave out the "
            "channels that buy least."
        )
    return [some for size in range(1, len(units) + 1) for some in combinations(units, size)]


def fallback_gains(plant: FusedPlant, missing: tuple[str, ...]) -> FloatArray:
    """Return the Kalman gains without some sensors, zero for what is missing, (N, n, q).

    Without any reading the plant's model predicts alone.
    """
    remaining = ~plant.unit_rows(missing)
    if not np.any(plant.read & remaining):
        return frozen_copy(np.zeros((plant.period, plant.n_states, plant.n_measurements)))
    return stacked_gains(kalman_riccati(plant.restricted(remaining)))


def stacked_gains(solution: FilterRiccati) -> FloatArray:
    """Return the predictor gains of a solution with an axis of phases, (N, n, q)."""
    gains = solution.gain_predictor
    return gains.reshape(-1, *gains.shape[-2:])


def make_fallbacks(plant: FusedPlant) -> tuple[Fallback, ...]:
    """Return the filter of the remaining sensors for every set that may fail."""
    return tuple(
        Fallback(missing=missing, gains=fallback_gains(plant, missing))
        for missing in failure_sets(plant.suite.units)
    )


def failure_rows(
    plant: FusedPlant, gains: FloatArray, fallbacks: tuple[Fallback, ...]
) -> tuple[FailureRow, ...]:
    """Return stability and residual of the loop for every set of sensors that fail.

    The residual is the exact one of the loop where the plant's model is the truth. A frozen reading
    is that of a frame in which all sensors are read, and stays for ever.

    Parameters
    ----------
    plant : FusedPlant
        Loop, disturbances and sensors.
    gains : (N, n, q) ndarray
        Predictor gains of the filter of all sensors.
    fallbacks : tuple of Fallback
        The filter for each set of sensors that fail.

    Returns
    -------
    tuple of FailureRow
        A row per fall-back.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> own = lbt.tip_tilt_plant(frame_rate_hz=1000, turbulence=slow, noise_nm=75, modes=1)
    >>> second = lbt.models.WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    >>> plant = lbt.models.fused_plant(own, lbt.models.SensorSuite(sensors=(second,)))
    >>> design = lbt.design.fused_kalman(plant)
    >>> rows = lbt.design.failure_rows(plant, design.gains, design.fallbacks)
    >>> [row.must_switch for row in rows]
    [False, False, False]
    """
    rows = []
    readings = model_readings(failed_loop(plant, gains, ()), plant)
    for fallback in fallbacks:
        unseen = failed_loop(plant, gains, fallback.missing)
        zero_nm = frozen_nm = None
        if unseen.is_stable:
            zero_nm = fused_model_budget(unseen, plant).rms_nm
            frozen_nm = float(np.hypot(zero_nm, _offset_nm(unseen, readings)))
        switched = failed_loop(plant, fallback.gains, fallback.missing)
        rows.append(
            FailureRow(
                missing=" + ".join(fallback.missing),
                unseen_radius=unseen.spectral_radius,
                zero_nm=zero_nm,
                frozen_nm=frozen_nm,
                fallback_radius=switched.spectral_radius,
                fallback_nm=fused_model_budget(switched, plant).rms_nm,
                must_switch=not unseen.is_stable,
            )
        )
    return tuple(rows)


def _offset_nm(loop: FusedLoop, readings: FloatArray) -> float:
    """Return what readings (q, q) that stay for ever leave of themselves [nm rms]."""
    n, rows = loop.hardware.modes, loop.suite.marked(loop.blind, loop.hardware)
    response = np.real(loop.system.phase_response(0.0)[0, :, :n, n:][:, :, rows])
    power = np.einsum("tij,jk,tik->t", response, readings[np.ix_(rows, rows)], response)
    return float(np.sqrt(np.mean(power)))


def failed_loop(plant: FusedPlant, gains: FloatArray, missing: tuple[str, ...]) -> FusedLoop:
    """Return the loop of a plant in which some sensors read zero."""
    return close_fused_loop(plant.own.hardware, plant.suite, plant.controller(gains), blind=missing)
