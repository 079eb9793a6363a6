"""What many loops meet that differ in a few numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models import (
    LoopHardware,
    SinusoidalVibration,
    Vibration,
)
from lbt_synth.models.vibration import require_below_nyquist
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    IntArray,
    frozen_copy,
    positive,
    real_array,
    set_fields,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleVibration:
    """A vibration whose numbers are one for all of p loops, or one for each, (p,)."""

    frequency_hz: Any
    rms_nm: Any
    direction: Any = (1.0, 0.0)  # over the modes, (n,) or (p, n); made a unit vector
    damping: Any = None  # without it the vibration is a sinusoid
    sections: int = 1  # resonances in series, of a bump
    readings: ComplexArray | None = None  # what they have of a unit sinusoid beside, (q,)

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "rms_nm", "damping"):
            if getattr(self, name) is not None:
                set_fields(self, **{name: positive(getattr(self, name), name)})
        direction = np.asarray(self.direction, dtype=np.float64)
        length = np.linalg.norm(direction, axis=-1, keepdims=True)
        set_fields(self, direction=frozen_copy(direction / length))

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers that it has, of which each may be one for each loop."""
        names = ("frequency_hz", "rms_nm", "damping", "direction")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def of_loops(self, p: int) -> EnsembleVibration:
        """Return it with all numbers (p,), and directions (p, n)."""
        one = {"direction": self.direction.shape[-1:]}  # the shape for one loop
        stacks: dict[str, Any] = {
            name: np.broadcast_to(value, (p, *one.get(name, ())))
            for name, value in self.numbers.items()
        }
        return replace(self, **stacks)

    def take(self, rows: IntArray) -> EnsembleVibration:
        """Return that of some loops, where all numbers are (p,)."""
        return replace(self, **{name: value[rows] for name, value in self.numbers.items()})


def ensemble_vibration(vibration: Vibration | SinusoidalVibration) -> EnsembleVibration:
    """Return a vibration as all loops meet it."""
    return EnsembleVibration(
        frequency_hz=vibration.frequency_hz,
        rms_nm=vibration.rms_nm,
        direction=vibration.direction,
        damping=vibration.damping if isinstance(vibration, Vibration) else None,
        sections=vibration.sections if isinstance(vibration, Vibration) else 1,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopEnsemble:
    """Conditions of p loops with the same sensor and mirror: one number for all, or one for each.

    The turbulence is one for all modes, or one for each: a spectrum for all loops, or an
    atmosphere or an AR model that is a stack with one for each.
    """

    sensor_gain: Any = 1.0  # real sensor gain relative to the sensor matrix
    delay_frames: Any = None  # total delay; that of the hardware by default
    noise_nm: Any = 0.0  # of each measurement per frame, also (p, q)
    noise_factor: FloatArray | None = None  # in its place, of its covariance for all loops, (q, w)
    turbulence: Any = None
    vibrations: tuple[EnsembleVibration, ...] = ()
    of_means: bool = False  # whether the rms of a resonance is of means over frames
    loops: int = 0  # how many loops; by default as many as there are numbers

    def __post_init__(self) -> None:
        noise = real_array(self.noise_nm, "noise_nm")
        if np.any(noise < 0):
            raise ProblemError(f"noise_nm must be at least 0; got {noise.min():.6g}.")
        set_fields(self, sensor_gain=positive(self.sensor_gain, "sensor_gain"), noise_nm=noise)
        values = [self.sensor_gain, self.noise_nm, self.delay_frames]
        for line in self.vibrations:
            values += [v for n, v in line.numbers.items() if np.ndim(v) > (n == "direction")]
        lengths = [len(value) for value in values if np.ndim(value)]
        counts = [getattr(air, "count", 1) for air in self.turbulence_of(1)]
        set_fields(self, loops=max([1, self.loops, *lengths, *counts]))

    def turbulence_of(self, modes: int) -> tuple[Any, ...]:
        """Return the turbulence as it is per mode, or for each of some modes."""
        one = not isinstance(self.turbulence, Sequence)
        return (self.turbulence,) * modes if one else tuple(self.turbulence)

    def noise(self, hardware: LoopHardware) -> FloatArray:
        """Return a factor of the covariance of the noise [nm], (p, q, w)."""
        q, noise = hardware.n_measurements, np.asarray(self.noise_nm)
        if self.noise_factor is not None:
            return np.broadcast_to(self.noise_factor, (self.loops, *self.noise_factor.shape))
        noise = noise[:, None] if noise.ndim == 1 else noise
        return np.broadcast_to(noise, (self.loops, q))[..., None] * np.eye(q)

    def lines(self, hardware: LoopHardware) -> list[EnsembleVibration]:
        """Return the vibrations with all their numbers (p,), and directions (p, n)."""
        for line in self.vibrations:
            require_below_nyquist(float(np.max(line.frequency_hz)), hardware.frame_rate_hz)
        return [line.of_loops(self.loops) for line in self.vibrations]
