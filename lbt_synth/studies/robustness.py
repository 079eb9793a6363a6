"""Robustness of designs to an error in the vibration's frequency, as in the paper's Table III."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.design import FilterDesign, hinf, kalman
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.loop import Imaging, close_loop, residual_budget, strehl
from lbt_synth.models import TipTiltPlant, Truth, retuned_plant
from lbt_synth.validation import choice, number

METHODS = ("kalman", "hinf")


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustnessRow:
    """One design at one frequency error.

    Attributes
    ----------
    error_hz : float
        Frequency in the model less the true one [Hz].
    method : str
        "kalman" or "hinf".
    strehl : float
        Strehl ratio in [0, 1]; nan if the loop is unstable.
    residual_nm : float
        Residual of tip and tilt [nm rms]; nan if the loop is unstable.
    vibration_nm, turbulence_nm, noise_nm : float
        Its parts [nm rms].
    stable : bool
        Whether the loop is stable with the real sensor gain.
    gamma : float
        H-infinity norm that the design achieves.
    """

    error_hz: float
    method: str
    strehl: float
    residual_nm: float
    vibration_nm: float
    turbulence_nm: float
    noise_nm: float
    stable: bool
    gamma: float


def robustness(
    plant: TipTiltPlant,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Sequence[float],
    methods: Sequence[str] = METHODS,
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
    methods : sequence of {"kalman", "hinf"}, optional
        Methods of design.
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
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=797)
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
    ... )
    >>> truth = lbt.Truth(
    ...     turbulence=slow,
    ...     noise_nm=15.5,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797),),
    ... )
    >>> rows = list(
    ...     lbt.studies.robustness(
    ...         plant, truth, lbt.Imaging(diameter_m=8.22), errors_hz=[0, 3], methods=["kalman"]
    ...     )
    ... )
    >>> rows[0].strehl > rows[1].strehl
    True
    """
    if not plant.vibrations:
        raise ProblemError(
            "a frequency error needs a vibration in the model; got a plant without any."
        )
    for method in methods:
        choice(method, "method", METHODS)
    for error in errors_hz:
        moved = retuned_plant(plant, number(error, "errors_hz"), hold=hold)
        for method in methods:
            if method == "kalman":
                design = kalman(moved)
            elif gamma is not None:
                design = hinf(moved, gamma=gamma, route="riccati")
            else:
                design = hinf(moved, gamma_ratio=gamma_ratio, route="riccati")
            yield _row(design, truth, imaging, float(error))


def _row(design: FilterDesign, truth: Truth, imaging: Imaging, error: float) -> RobustnessRow:
    assert design.hardware is not None  # this module designs for plants
    loop = close_loop(design.hardware, design.controller, sensor_gain=truth.sensor_gain)
    try:
        budget = residual_budget(loop, truth)
    except UnstableLoopError:
        values = dict.fromkeys(
            ("strehl", "residual_nm", "vibration_nm", "turbulence_nm", "noise_nm"), np.nan
        )
        return RobustnessRow(
            error_hz=error, method=design.method, stable=False, gamma=design.gamma, **values
        )
    return RobustnessRow(
        error_hz=error,
        method=design.method,
        strehl=strehl(budget, imaging),
        residual_nm=budget.rms_nm,
        vibration_nm=budget.vibration_nm,
        turbulence_nm=budget.turbulence_nm,
        noise_nm=budget.noise_nm,
        stable=True,
        gamma=design.gamma,
    )
