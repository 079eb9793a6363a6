"""The truth of a simulation: the real disturbances and sensor, whatever the design assumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.sensor_suite import Motions
from lbt_synth.models.spectra import ARModel, Spectrum, spectrum_groups
from lbt_synth.models.vibration import (
    SinusoidalVibration,
    TrueVibration,
    Vibration,
    stationary_vibrations,
)
from lbt_synth.storage.summaries import Summarised
from lbt_synth.storage.words import count_text
from lbt_synth.validation import (
    FloatArray,
    Positive,
    check_fields,
    frozen_copy,
    number,
    one_or_each,
    sequence,
)

# spectra with the modes that have them, vibrations, and a root of the covariance of the noise
Entering: TypeAlias = tuple[
    Sequence[tuple[Spectrum, list[int]]],
    Sequence[Vibration | SinusoidalVibration],
    FloatArray,
]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth(Summarised):
    """Disturbances and sensor of the real loop.

    Parameters
    ----------
    turbulence : Spectrum, sequence of (Spectrum or None), or None
        Spectrum of each mode, the modes independent: one for all of them, or one per mode; None
        for no turbulence.
    vibrations : tuple of Vibration or SinusoidalVibration, optional
        The vibrations that are really there. One that drifts can only be simulated.
    noise_nm : float or (q,) array_like, optional
        Standard deviation of the noise on each measurement, per frame [nm]: one for all of
        them, or one per measurement.
    sensor_gain : float, optional
        Real sensor (optical) gain relative to the sensor matrix:
        ``y = sensor_gain D phi_res + noise``. Put gains that differ between the axes
        into the sensor matrix of the loop.
    frequency_errors_hz : sequence of float, optional
        How far the frequency of each vibration may be from the assumed one [Hz]; 0 where it is
        known. Studies of frequency errors move the vibrations in proportion to these; by default
        in proportion to their frequencies.
    motions : sequence of mapping, optional
        For each vibration, the :class:`~lbt_synth.models.Motion` of each channel of an
        accelerometer that it moves; by default none moves.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.
    DimensionError
        If a sequence is empty, or ``noise_nm`` has more than one dimension.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> calm = lbt.Truth(turbulence=None, noise_nm=15.5)
    >>> calm.sensor_gain
    1.0
    """

    turbulence: Spectrum | Sequence[Spectrum | None] | None
    vibrations: tuple[TrueVibration, ...] = ()
    noise_nm: float | FloatArray = 0.0
    sensor_gain: Positive = 1.0
    frequency_errors_hz: tuple[float, ...] | None = None
    motions: Motions = ()

    def __post_init__(self) -> None:
        turbulence = self.turbulence
        if isinstance(turbulence, ARModel) and turbulence.coefficients.ndim > 1:
            turbulence = turbulence.separate()
        parts = tuple(turbulence) if isinstance(turbulence, Sequence) else (turbulence,)
        if not parts:
            raise DimensionError(
                "turbulence must be one spectrum, or one per mode; got an empty sequence. For no "
                "turbulence give None."
            )
        for part in parts:
            if part is not None and not isinstance(part, Spectrum):
                raise ProblemError(
                    "turbulence must have a method psd(frequency_hz), or be None, or a sequence "
                    f"of these, one per mode; got {type(part).__name__}."
                )
        for line in sequence(self.vibrations, "vibrations"):
            if not isinstance(line, TrueVibration):
                raise ProblemError(
                    "vibrations must be Vibration or SinusoidalVibration; got "
                    f"{type(line).__name__}."
                )
        noise, errors = one_or_each(self.noise_nm, "noise_nm", at_least=0), self.frequency_errors_hz
        if errors is not None:
            name, lines = "frequency_errors_hz", len(self.vibrations)
            errors = tuple(number(error, name, at_least=0) for error in errors)
            if len(errors) != lines:
                raise DimensionError(f"{name} must be one per vibration ({lines}); got {errors}.")
        check_fields(
            self,
            turbulence=parts if isinstance(turbulence, Sequence) else turbulence,
            vibrations=tuple(self.vibrations),
            noise_nm=float(noise) if noise.ndim == 0 else noise,
            frequency_errors_hz=errors,
            motions=tuple(self.motions) if any(self.motions) else ({},) * len(self.vibrations),
        )

    def _brief(self) -> str:
        lines = count_text(len(self.vibrations), "vibration")
        return f"{lines}, sensor gain {self.sensor_gain:.4g}"

    @property
    def lines_hz(self) -> list[float]:
        """Frequencies of the vibrations [Hz], rising, each once; one that drifts is refused."""
        return sorted({line.frequency_hz for line in stationary_vibrations(self.vibrations)})

    def frequency_shifts_hz(self, error_hz: float) -> FloatArray:
        """Return how far each vibration moves, (vibrations,), if the one that moves most does so.

        Each moves by its own share of the error [Hz].
        """
        sizes = self.frequency_errors_hz
        if sizes is None:
            sizes = tuple(line.frequency_hz for line in stationary_vibrations(self.vibrations))
        largest = max([*sizes, np.finfo(float).tiny])
        return np.array([error_hz * size / largest for size in sizes])

    def frequency_shift_hz(self, frequency_hz: float, error_hz: float) -> float:
        """Return how far a line moves with an error of the vibration that moves most [Hz].

        The line takes the share of the vibration that is nearest to it in frequency. Without
        vibrations it moves by the whole error.
        """
        lines = stationary_vibrations(self.vibrations)
        if not lines:
            return error_hz
        places = np.array([line.frequency_hz for line in lines])  # as the shifts are ordered
        nearest = np.argmin(np.abs(np.log(places / frequency_hz)))
        return float(self.frequency_shifts_hz(error_hz)[nearest])

    def moved_hz(self, error_hz: float) -> FloatArray:
        """Return frequencies (vibrations,) if the vibration that moves most does so by an error."""
        before = np.array([line.frequency_hz for line in stationary_vibrations(self.vibrations)])
        moved = before + self.frequency_shifts_hz(error_hz)
        for frequency_hz, line_hz in zip(moved, before, strict=True):
            if not frequency_hz > 0:
                raise ProblemError(
                    f"errors_hz must leave each vibration above 0 Hz; got an error of "
                    f"{error_hz:.6g} Hz, which moves the one at {line_hz:.6g} Hz to "
                    f"{frequency_hz:.6g} Hz. Try a smaller one, or a smaller error of this line."
                )
        return np.asarray(moved)

    def with_frequency_error(self, error_hz: float) -> Truth:
        """Return a truth whose vibrations have moved, the one that moves most by an error [Hz]."""
        pairs = zip(self.vibrations, self.moved_hz(error_hz).tolist(), strict=True)
        moved = tuple(replace(line, frequency_hz=frequency_hz) for line, frequency_hz in pairs)
        return replace(self, vibrations=moved)

    @property
    def drifts(self) -> bool:
        """Whether a vibration drifts, so that the truth can only be simulated."""
        return any(getattr(line, "drifts", False) for line in self.vibrations)

    @property
    def is_uniform(self) -> bool:
        """Whether one spectrum, or None, was given for all modes."""
        return not isinstance(self.turbulence, tuple)

    def turbulence_per_mode(self, modes: int) -> tuple[Spectrum | None, ...]:
        """Return each mode's spectrum, or None; another number of modes is a DimensionError."""
        if not isinstance(self.turbulence, tuple):
            return (self.turbulence,) * modes  # type: ignore[return-value]
        if len(self.turbulence) != modes:
            raise DimensionError(
                f"turbulence must be one spectrum, or one per mode ({modes}); got "
                f"{len(self.turbulence)}."
            )
        return self.turbulence

    # what the rms of a resonance is of: all moments, not means over frames
    is_of_means: ClassVar[bool] = False

    def entering(self, hardware: LoopHardware, *, sensor_gain: float) -> Entering:
        """Return what enters a loop that is closed with a sensor gain over the assumed one.

        Another gain than that of the truth, and a vibration that drifts, are a ProblemError.
        """
        if sensor_gain != self.sensor_gain:
            raise ProblemError(
                f"the loop must be closed with the truth's sensor gain {self.sensor_gain:.6g}; "
                f"got {sensor_gain:.6g}."
            )
        noise = np.diag(self.noise_per_measurement(hardware.n_measurements))
        lines = stationary_vibrations(self.vibrations)
        return self.turbulence_groups(hardware.modes), lines, noise

    def turbulence_groups(self, modes: int) -> list[tuple[Spectrum, list[int]]]:
        """Return the different spectra, each with the modes that have it; other modes have none."""
        return spectrum_groups(self.turbulence_per_mode(modes))

    def noise_per_measurement(self, measurements: int) -> FloatArray:
        """Return the standard deviation of the noise on each measurement, (q,) [nm].

        Deviations for another number of measurements are a DimensionError.
        """
        noise = one_or_each(self.noise_nm, "noise_nm", measurements)
        return frozen_copy(np.broadcast_to(noise, (measurements,)))
