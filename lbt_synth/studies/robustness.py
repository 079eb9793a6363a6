"""Robustness of designs to an error in the vibration's frequency, as in the paper's Table III."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop import Imaging, close_loop, residual_budget, strehl
from lbt_synth.methods.plant_inputs import reference_design
from lbt_synth.methods.registry import record_methods, reference_methods
from lbt_synth.models import TipTiltPlant, Truth, retuned_plant
from lbt_synth.storage.rows import column, fill_row, nm_column, percent_column, table_row
from lbt_synth.validation import choice, number


@table_row
class RobustnessRow:
    """One design at one frequency error; what an unstable loop does not have is nan."""

    error_hz: float = column(
        "error", unit="Hz", format="+.2f", help="Frequency in the model less the true one"
    )
    method: str = column("method", help="Method of synthesis")
    strehl: float = percent_column("Strehl", help="Strehl ratio in [0, 1]", default=np.nan)
    residual_nm: float = nm_column("residual", help="Residual of tip and tilt, rms", default=np.nan)
    vibration_nm: float = nm_column("vibration", help="Its part of vibrations, rms", default=np.nan)
    turbulence_nm: float = nm_column(
        "turbulence", help="Its part of turbulence, rms", default=np.nan
    )
    noise_nm: float = nm_column("noise", help="Its part of noise, rms", default=np.nan)
    stable: bool = column("stable", help="Whether the loop is stable with the real sensor gain")
    gamma: float = column(unit="nm", help="H-infinity norm that the design achieves")


def robustness(
    plant: TipTiltPlant,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Sequence[float],
    methods: Sequence[str] | None = None,
    gamma_ratio: float = 1.2,
    gamma: float | None = None,
    hold: str = "driving",
) -> Iterator[RobustnessRow]:
    """Design at each frequency error and evaluate exactly against the same truth.

    Parameters
    ----------
    plant : TipTiltPlant
        Plant whose vibrations are moved.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    errors_hz : sequence of float
        Errors of the model's frequency [Hz].
    methods : sequence of str, optional
        Methods of synthesis that design for a plant; by default the Kalman and the H-infinity
        filter.
    gamma_ratio : float, optional
        H-infinity bound as a multiple of each row's least gamma.
    gamma : float, optional
        One H-infinity bound for all rows, instead of the ratio.
    hold : {"driving", "rms"}, optional
        What the model keeps of a vibration when its frequency moves.

    Yields
    ------
    RobustnessRow
        In the order of errors, then methods.

    Raises
    ------
    ProblemError
        If the plant has no vibration, or a value is out of range.
    SynthesisError
        If a design fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> found = lbt.studies.robustness(
    ...     config.plant, config.truth, config.imaging, errors_hz=[0, 3], methods=["kalman"]
    ... )
    >>> rows = list(found)
    >>> rows[0].strehl > rows[1].strehl
    True
    """
    if not plant.vibrations:
        raise ProblemError(
            "a frequency error needs a vibration in the model; got a plant without any."
        )
    names = default_methods() if methods is None else methods
    for name in names:
        choice(name, "method", record_methods())
    bound = {"gamma_ratio": gamma_ratio} if gamma is None else {"gamma": gamma}
    for error in errors_hz:
        moved = retuned_plant(plant, number(error, "errors_hz"), hold=hold)
        for name in names:
            yield _row(reference_design(name, moved, bound), truth, imaging, float(error))


def default_methods() -> list[str]:
    """Return the methods whose rows are computed unless others are named."""
    return [method.name for method in reference_methods(estimators_only=True)]


def _row(design: Design, truth: Truth, imaging: Imaging, error: float) -> RobustnessRow:
    assert design.hardware is not None  # this module designs for plants
    loop = close_loop(design.hardware, design.controller, sensor_gain=truth.sensor_gain)
    known = {"error_hz": error, "stable": loop.is_stable}
    if not loop.is_stable:
        return fill_row(RobustnessRow, design, **known)
    budget = residual_budget(loop, truth)
    return fill_row(
        RobustnessRow,
        budget,
        design,
        **known,
        strehl=strehl(budget, imaging),
        residual_nm=budget.rms_nm,
    )
