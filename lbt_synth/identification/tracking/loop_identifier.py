"""The identifier that finds the whole model of a loop in each window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.fit.axis import identify_axis
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedModel
from lbt_synth.models import TipTiltPlant
from lbt_synth.validation import FloatArray, integer, require_instance


class LoopIdentifier:
    """Identify turbulence, lines and noise of each axis in a window (:func:`identify_axis`).

    Each window starts from the model of the last one. A window that does not show the sensor gain
    takes that of the plant.

    Parameters
    ----------
    plant : TipTiltPlant
        Loop, and sensor gains in its sensor matrix: one measurement per axis.
    find_gain : bool, optional
        Whether the sensor gain is found; otherwise it is the plant's.
    most_lines : int, optional
        Most resonances per axis. A line that drifts within the window looks like several, which
        take long and change nothing.

    Raises
    ------
    ProblemError
        If a measurement sees more than its own axis.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=100, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=500, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> moved = lbt.Vibration(frequency_hz=43, damping=0.01, rms_nm=100, direction=(1,))
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(moved,), noise_nm=15.5)
    >>> tracker = lbt.identification.TrackingController(
    ...     plant, lbt.identification.LoopIdentifier(plant), window_s=4
    ... )
    >>> run = lbt.simulate(tracker, truth, hardware=plant.hardware, frames=2000)
    >>> bool(min(abs(np.array(tracker.history[-1].frequencies_hz) - 43)) < 0.5)
    True
    """

    def __init__(self, plant: TipTiltPlant, *, find_gain: bool = True, most_lines: int = 2) -> None:
        require_instance(plant, TipTiltPlant)
        sensor = plant.hardware.sensor
        gains = np.diag(sensor)
        if not np.array_equal(sensor, np.diag(gains)) or np.any(gains <= 0):
            raise ProblemError(
                "each measurement must be of one axis, with a gain above 0; got a sensor matrix "
                f"{sensor.tolist()}. Recombine the measurements into axes before the controller."
            )
        self._plant, self._gains, self._find_gain = plant, gains.tolist(), bool(find_gain)
        self._most_lines = integer(most_lines, "most_lines", at_least=0)
        self.reset()

    def reset(self) -> None:
        """Forget the last window."""
        self._last: Sequence[IdentifiedAxis | None] = [None] * len(self._gains)

    def __call__(self, measurements: FloatArray, corrections: FloatArray) -> TipTiltPlant | None:
        """Identify a window of measurements and corrections, (frames, n)."""
        hw, count = self._plant.hardware, len(self._gains)
        if measurements.shape[1:] != (count,) or corrections.shape != measurements.shape:
            raise DimensionError(
                f"the series must be (frames, {count}); got {measurements.shape} and "
                f"{corrections.shape}."
            )
        last, self._last = self._last, [None] * count  # a fit that fails is no start
        found = tuple(
            identify_axis(
                y,
                c,
                frame_rate_hz=hw.frame_rate_hz,
                sensor_gain=None if self._find_gain else gain,
                assumed_gain=gain,
                most_lines=self._most_lines,
                start=start,
            )
            for y, c, gain, start in zip(
                measurements.T, corrections.T, self._gains, last, strict=True
            )
        )
        model = IdentifiedModel(
            axes=found,
            frame_rate_hz=hw.frame_rate_hz,
            delay_frames=hw.delay_frames,
            mirror=hw.mirror,
        )
        plant, self._last = model.plant(), found
        return replace(plant, hardware=replace(plant.hardware, influence_matrix=hw.influence))
