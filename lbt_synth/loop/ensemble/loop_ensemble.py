"""An ensemble of loops: gains, delays, noise, turbulence, vibrations, one entry per loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import (
    FrozenFlows,
    LoopHardware,
    ModalTurbulence,
    SinusoidalVibration,
    Spectrum,
    Vibration,
)
from lbt_synth.models.loop_hardware import LONGEST_DELAY
from lbt_synth.models.spectra import spectrum_key
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    frozen_copy,
    positive,
    real_array,
    require_instance,
    sequence,
    set_fields,
)

Turbulence: TypeAlias = Spectrum | FrozenFlows | ModalTurbulence


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleVibration:
    """A vibration that differs between p loops.

    Parameters
    ----------
    frequency_hz : float or (p,) array_like
        Frequency [Hz].
    rms_nm : float or (p,) array_like
        Standard deviation along its direction [nm rms wavefront].
    direction : (n,) or (p, n) array_like, optional
        Direction over the modes, made a unit vector; along the first of two by default.
    damping : float or (p,) array_like, optional
        Damping ratio, above 0; without it the vibration is a sinusoid.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.loop.EnsembleVibration(frequency_hz=[19.5, 20.0, 20.5], rms_nm=563.6)
    >>> line.damping is None
    True
    """

    frequency_hz: Any
    rms_nm: Any
    direction: Any = (1.0, 0.0)
    damping: Any = None

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "rms_nm", "damping"):
            if getattr(self, name) is not None:
                set_fields(self, **{name: positive(getattr(self, name), name)})
        direction = real_array(self.direction, "direction")
        size = np.linalg.norm(np.atleast_1d(direction), axis=-1, keepdims=True)
        if direction.ndim not in (1, 2) or not np.all(size > 0):
            wanted = "a vector over the modes, or one per loop, and not zero"
            raise ProblemError(f"direction must be {wanted}; got shape {direction.shape}.")
        set_fields(self, direction=frozen_copy(direction / size))


def ensemble_vibration(vibration: Vibration | SinusoidalVibration) -> EnsembleVibration:
    """Return a vibration as all loops meet it."""
    return EnsembleVibration(
        frequency_hz=vibration.frequency_hz,
        rms_nm=vibration.rms_nm,
        direction=vibration.direction,
        damping=vibration.damping if isinstance(vibration, Vibration) else None,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopEnsemble:
    """Conditions of p loops with the same sensor and mirror.

    Parameters
    ----------
    sensor_gain : float or (p,) array_like, optional
        Real sensor gain of each loop relative to the sensor matrix.
    delay_frames : float or (p,) array_like, optional
        Real total delay [frames], 1 to 20; that of the loop by default.
    noise_nm : float, (p,) or (p, q) array_like, optional
        Standard deviation of the noise on each measurement per frame [nm].
    turbulence : Spectrum, FrozenFlows, ModalTurbulence, sequence of these, or None, optional
        Spectrum of each mode, the modes independent: one for all of them, or one per mode. A
        FrozenFlows or ModalTurbulence holds one per loop, any other spectrum serves all loops.
    vibrations : sequence of EnsembleVibration, optional
        The vibrations.
    loops : int, optional
        Number of loops p, where no array gives it.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.
    DimensionError
        If arrays have different lengths.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> weak = lbt.loop.LoopEnsemble(sensor_gain=[0.4, 0.7, 1.0], noise_nm=15.5)
    >>> weak.loops
    3
    """

    sensor_gain: Any = 1.0
    delay_frames: Any = None
    noise_nm: Any = 0.0
    turbulence: Any = None
    vibrations: tuple[EnsembleVibration, ...] = ()
    loops: int = 0

    def __post_init__(self) -> None:
        set_fields(self, vibrations=sequence(self.vibrations, "vibrations"))
        for line in self.vibrations:
            require_instance(line, EnsembleVibration)
        noise = real_array(self.noise_nm, "noise_nm")
        if np.any(noise < 0):
            raise ProblemError(f"noise_nm must be at least 0; got {noise.min():.6g}.")
        set_fields(self, sensor_gain=positive(self.sensor_gain, "sensor_gain"), noise_nm=noise)
        if self.delay_frames is not None:
            delay = real_array(self.delay_frames, "delay_frames")
            if np.any((delay < 1) | (delay > LONGEST_DELAY)):
                bounds, got = f"at least 1 and at most {LONGEST_DELAY}", delay.ravel().tolist()
                raise ProblemError(f"delay_frames must be {bounds}; got {got}.")
            set_fields(self, delay_frames=delay)
        lengths = {len(values) for values in self._values_per_loop()} | ({self.loops} - {0})
        if len(lengths - {1}) > 1:
            raise DimensionError(
                f"all must have one entry per loop; got {sorted(lengths)} entries."
            )
        if 0 in lengths:
            raise DimensionError("an ensemble needs at least one loop; got none.")
        set_fields(self, loops=max(lengths, default=1))

    def _values_per_loop(self) -> list[FloatArray]:
        """Return all arrays that have one entry per loop."""
        values = [self.sensor_gain, self.noise_nm, self.delay_frames]
        for line in self.vibrations:
            values += [line.frequency_hz, line.rms_nm, line.damping]
            values += [line.direction] if line.direction.ndim == 2 else []
        for part in self._turbulence_parts(1):
            values += _turbulence_values(part)
        return [value for value in values if np.ndim(value)]

    def _turbulence_parts(self, modes: int) -> tuple[Any, ...]:
        """Return the turbulence as it is per mode, or for each of some modes."""
        one = not isinstance(self.turbulence, Sequence)
        return (self.turbulence,) * modes if one else tuple(self.turbulence)

    def delays(self, hardware: LoopHardware) -> FloatArray:
        """Return the total delay of each loop [frames], (p,)."""
        delay = hardware.delay_frames if self.delay_frames is None else self.delay_frames
        return np.broadcast_to(delay, (self.loops,))

    def gains(self) -> FloatArray:
        """Return the sensor gain of each loop, (p,)."""
        return np.broadcast_to(self.sensor_gain, (self.loops,))

    def noise(self, hardware: LoopHardware) -> FloatArray:
        """Return the noise of each measurement [nm], (p, q)."""
        q, given = hardware.n_measurements, np.asarray(self.noise_nm)
        given = given[:, None] if given.ndim == 1 else given
        if given.ndim == 2 and given.shape[1] not in (1, q):
            got = given.shape[1]
            raise DimensionError(f"noise_nm must have one column per measurement ({q}); got {got}.")
        return np.broadcast_to(given, (self.loops, q))

    def groups(self, hardware: LoopHardware) -> list[tuple[Turbulence, tuple[int, ...]]]:
        """Return the turbulence with the modes that have it."""
        n, parts = hardware.modes, self._turbulence_parts(hardware.modes)
        if len(parts) != n:
            raise DimensionError(
                f"turbulence must have one entry per mode ({n}); got {len(parts)}."
            )
        groups: dict[object, tuple[Turbulence, tuple[int, ...]]] = {}
        for mode, part in enumerate(parts):
            if part is not None:
                first, modes = groups.get(spectrum_key(part), (part, ()))
                groups[spectrum_key(part)] = (first, (*modes, mode))
        return list(groups.values())

    def distinct(self, hardware: LoopHardware, *, apart: bool) -> tuple[IntArray, IntArray]:
        """Return rows that differ by more than their vibrations, and which of them each loop has.

        With ``apart`` all rows differ, as each has its own controller.
        """
        rows = np.arange(self.loops)
        if apart:
            return rows, rows
        columns = [self.gains(), self.delays(hardware), *self.noise(hardware).T]
        for part, _ in self.groups(hardware):
            columns += _turbulence_values(part)
        table = np.stack(np.broadcast_arrays(*columns), axis=1)
        _, first, which = np.unique(table, axis=0, return_index=True, return_inverse=True)
        return first, which.reshape(-1)

    def lines(self, hardware: LoopHardware) -> list[EnsembleVibration]:
        """Return the vibrations with all their arrays (p,), and directions (p, n)."""
        out, p, n, nyquist = [], self.loops, hardware.modes, hardware.frame_rate_hz / 2
        for line in self.vibrations:
            if line.direction.shape[-1] != n:
                got = line.direction.shape[-1]
                raise DimensionError(
                    f"the direction of a vibration must have {n} components, one per mode; got "
                    f"{got}."
                )
            if not np.max(line.frequency_hz) < nyquist:
                limit, got = f"the Nyquist frequency {nyquist:.6g} Hz", np.max(line.frequency_hz)
                raise ProblemError(f"a vibration must lie below {limit}; got {got:.6g} Hz.")
            values = {name: getattr(line, name) for name in ("frequency_hz", "rms_nm", "damping")}
            whole = {k: np.broadcast_to(v, (p,)) for k, v in values.items() if v is not None}
            out.append(replace(line, **whole, direction=np.broadcast_to(line.direction, (p, n))))
        return out


def _turbulence_values(turbulence: Turbulence | None) -> list[FloatArray]:
    """Return the arrays of a turbulence that have one entry per loop."""
    if isinstance(turbulence, FrozenFlows):
        values = turbulence.seeing_arcsec, turbulence.wind_speed_m_s, turbulence.outer_scale_m
        return [value for value in values if value is not None]
    if isinstance(turbulence, ModalTurbulence):
        return [*turbulence.coefficients.T, turbulence.driving_rms_nm]
    if turbulence is not None and not isinstance(turbulence, Spectrum):
        raise ProblemError(
            "turbulence must be a spectrum, FrozenFlows, ModalTurbulence or None, or a sequence of "
            f"these; got {type(turbulence).__name__}."
        )
    return []


def turbulence_rows(turbulence: Turbulence, rows: IntArray) -> Turbulence:
    """Return the turbulence of some loops."""
    if isinstance(turbulence, FrozenFlows) and len(turbulence) > 1:
        return turbulence.take(rows)
    if isinstance(turbulence, ModalTurbulence) and turbulence.n_modes > 1:
        a, driving = turbulence.coefficients[rows], turbulence.driving_rms_nm[rows]
        return replace(turbulence, coefficients=a, driving_rms_nm=driving)
    return turbulence
