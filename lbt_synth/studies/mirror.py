"""What it costs to ignore the dynamics of the mirror: four designs on one moving mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.design import Design, kalman, lqg, optimal_integrator
from lbt_synth.errors import ProblemError
from lbt_synth.loop import Imaging, close_loop, settling_error
from lbt_synth.models import TipTiltPlant, Truth
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.studies.grid import loop_columns
from lbt_synth.validation import require_instance


@table_row
class MirrorRow:
    """One design on the real mirror; what an unstable loop does not have is nan."""

    design: str = column("design", help="Its name: for ours, what it assumes about the mirror")
    stable: bool = column(help="Whether its loop is stable")
    residual_nm: float = nm_column(
        "residual",
        format=".2f",
        missing="unstable",
        help="Residual under the truth, rms",
    )
    strehl: float = percent_column("Strehl", help="Strehl ratio in [0, 1]")
    unsettled_nm: float = nm_column(
        "settled less real position",
        format=".2f",
        help="What is left of the assumption that the mirror has settled, for the commands of "
        "this design: settled less real position, rms",
    )


def mirror(
    plant: TipTiltPlant,
    truth: Truth,
    imaging: Imaging,
    *,
    command_weight: float = 0.0,
) -> tuple[MirrorRow, ...]:
    """Compare designs on a moving mirror: what it costs to ignore its dynamics.

    They are the integrator with the best gain on this mirror, the Kalman filter for a mirror
    that settles at once, the same filter with the real positions taken out of its measurements,
    and the LQG, which also commands for the dynamics. Each runs on the plant's own mirror.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant, with the real mirror in its hardware.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    command_weight : float, optional
        As for :func:`lqg`.

    Returns
    -------
    tuple of MirrorRow
        One per design.

    Raises
    ------
    ProblemError
        If the plant does not come from :func:`tip_tilt_plant`.
    SynthesisError
        If a design fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=20, damping=0.5, bandwidth_hz=60
    ... )
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5, mirror=shell)
    >>> rows = lbt.studies.mirror(
    ...     plant, lbt.Truth(turbulence=slow, noise_nm=15.5), lbt.Imaging(diameter_m=8.22)
    ... )
    >>> [(row.design, row.stable) for row in rows][1::2]
    [('kalman, settled mirror', False), ('lqg', True)]
    """
    if not isinstance(plant, TipTiltPlant):
        raise ProblemError(f"a mirror study needs a TipTiltPlant; got {type(plant).__name__}.")
    require_instance(truth, Truth)
    require_instance(imaging, Imaging)
    hardware = plant.hardware
    settled = replace(plant, hardware=replace(hardware, mirror=None))
    regulated = lqg(plant, command_weight=command_weight)
    designs: dict[str, Design] = {
        "integrator, best gain": optimal_integrator(hardware, truth),
        "kalman, settled mirror": kalman(settled),
        "kalman, real positions": kalman(plant),
        regulated.method: regulated,
    }
    rows = []
    for name, design in designs.items():
        loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
        numbers = loop_columns(loop, truth, imaging)
        rows.append(
            MirrorRow(
                design=name,
                stable=loop.is_stable,
                residual_nm=numbers["residual_nm"],
                strehl=numbers["strehl"],
                unsettled_nm=settling_error(loop, truth).rms_nm if loop.is_stable else np.nan,
            )
        )
    return tuple(rows)
