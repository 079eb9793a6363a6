"""Vibrations whose frequency has a distribution, as several lines with a share each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.models.plant.tip_tilt import TipTiltPlant, assemble
from lbt_synth.models.sensor_suite import Motions
from lbt_synth.models.vibration import Vibration
from lbt_synth.validation import FloatArray, integer, number, real_array

_MOST_LINES = 64


def spread_plant(
    plant: TipTiltPlant,
    *,
    half_width_hz: float | None = None,
    lines: int = 5,
    frequencies_hz: ArrayLike | None = None,
    weights: ArrayLike | None = None,
) -> TipTiltPlant:
    """Return a plant whose vibrations have a distribution of frequencies.

    Each vibration becomes several of the same direction and decay rate, its variance shared
    among them by the weights. Their sum has the mean spectrum of the plants with one of
    these frequencies each, so :func:`kalman` of the result has the least variance on
    average over the distribution.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant.
    half_width_hz : float, optional
        The frequencies are the mid-points of equal parts of [f - h, f + h], for each f [Hz].
    lines : int, optional
        Number of parts, at most 64; with ``half_width_hz``.
    frequencies_hz : (lines,) array_like, optional
        The frequencies themselves [Hz], instead of a half width; for a plant whose
        vibrations share one frequency.
    weights : (lines,) array_like, optional
        Probabilities of the frequencies, in proportion; equal by default.

    Returns
    -------
    TipTiltPlant
        The plant, with as many vibrations for each one.

    Raises
    ------
    ProblemError
        If there is no vibration, neither or both of half width and frequencies are given, or
        a frequency leaves (0, Nyquist).

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
    ... )
    >>> spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4)
    >>> [line.frequency_hz for line in spread.vibrations]
    [19.25, 19.75, 20.25, 20.75]
    """
    parts = plant.parts()  # refuses the memory of a mixed filter
    if not plant.vibrations:
        raise ProblemError(
            "a frequency prior needs a plant with a vibration; got one without any. Try "
            "tip_tilt_plant(..., vibrations=[Vibration(...)])."
        )
    if (half_width_hz is None) == (frequencies_hz is None):
        raise ProblemError(
            "give one of half_width_hz and frequencies_hz; "
            f"got half_width_hz={half_width_hz!r} and frequencies_hz={frequencies_hz!r}."
        )
    first = plant.vibrations[0].frequency_hz
    made: list[Vibration] = []
    motions: Motions = ()
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        if frequencies_hz is None:
            given = line_frequencies(line.frequency_hz, half_width_hz, lines)
        else:
            given = np.atleast_1d(real_array(frequencies_hz, "frequencies_hz"))
            if line.frequency_hz != first:
                raise ProblemError(
                    "frequencies_hz is for vibrations of one frequency; got vibrations at "
                    f"{first:.6g} and {line.frequency_hz:.6g} Hz. Try half_width_hz."
                )
        made += spread_lines(line, given, weights)
        motions += (motion,) * (len(made) - len(motions))
    return assemble(replace(parts, vibrations=tuple(made), motions=motions))


def line_frequencies(
    frequency_hz: float, half_width_hz: float | None, lines: int, *, name: str = "half_width_hz"
) -> FloatArray:
    """Mid-points of equal parts of an interval of frequencies."""
    half = number(
        half_width_hz,
        name,
        above=0,
        below=frequency_hz,
        hint="All frequencies must stay above 0 Hz.",
    )
    count = integer(lines, "lines", at_least=1, at_most=_MOST_LINES)
    return frequency_hz + half * ((2 * np.arange(count) + 1) / count - 1)


def spread_lines(
    line: Vibration, frequencies_hz: Sequence[float] | FloatArray, weights: Any = None
) -> list[Vibration]:
    """Split a vibration into several of its direction, decay rate and total variance."""
    count = len(frequencies_hz)
    share = np.ones(count) if weights is None else np.atleast_1d(real_array(weights, "weights"))
    if share.shape != (count,) or not np.all(share > 0):
        raise ProblemError(
            f"weights must be {count} positive numbers, one for each frequency; got {weights!r}."
        )
    parts = np.sqrt(share / share.sum())
    return [
        replace(line.at_frequency(float(f)), rms_nm=line.rms_nm * float(part))
        for f, part in zip(frequencies_hz, parts, strict=True)
    ]
