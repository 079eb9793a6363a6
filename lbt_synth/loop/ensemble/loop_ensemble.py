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
        Damping ratio, between 0 and 1; without it the vibration is a sinusoid.

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
        for name, high in (("frequency_hz", np.inf), ("rms_nm", np.inf), ("damping", 1.0)):
            if getattr(self, name) is None:
                continue
            value = real_array(getattr(self, name), name)
            if np.any(value <= 0) or np.any(value >= high):
                allowed = "above 0" if high == np.inf else "between 0 and 1"
                got = f"{value.min():.6g} to {value.max():.6g}"
                raise ProblemError(f"{name} must be {allowed}; got {got}.")
            set_fields(self, **{name: value})
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
        for name, bound in (("sensor_gain", 0.0), ("noise_nm", 0.0), ("delay_frames", 1.0)):
            if name == "delay_frames" and self.delay_frames is None:
                continue
            value = real_array(getattr(self, name), name)
            if name == "delay_frames" and np.any(value > LONGEST_DELAY):
                raise ProblemError(f"{name} must be at most {LONGEST_DELAY}; got {value.max():g}.")
            if np.any(value < bound) or (name == "sensor_gain" and np.any(value == 0)):
                word = "above" if name == "sensor_gain" else "at least"
                raise ProblemError(f"{name} must be {word} {bound:g}; got {value.min():.6g}.")
            set_fields(self, **{name: value})
        lengths = {name: len(values) for name, values in self._arrays().items()}
        lengths |= {} if self.loops == 0 else {"loops": self.loops}
        if len(set(lengths.values()) - {1}) > 1:
            text = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise DimensionError(f"all must have one entry per loop; got {text}.")
        if 0 in lengths.values():
            raise DimensionError("an ensemble needs at least one loop; got none.")
        set_fields(self, loops=max(lengths.values(), default=1))

    def _arrays(self) -> dict[str, Any]:
        """Return what has one entry per loop, by name."""
        names = ("sensor_gain", "noise_nm", "delay_frames")
        out = {name: getattr(self, name) for name in names if np.ndim(getattr(self, name))}
        for i, line in enumerate(self.vibrations):
            for name in ("frequency_hz", "rms_nm", "damping", "direction"):
                value = getattr(line, name)
                if value is not None and np.ndim(value) > (name == "direction"):
                    out[f"{name} of vibration {i}"] = value
        for part in self._each_turbulence(1):
            if isinstance(part, FrozenFlows):
                out["turbulence"] = part
            elif isinstance(part, ModalTurbulence):
                out["turbulence"] = part.coefficients
            elif part is not None and not isinstance(part, Spectrum):
                raise ProblemError(
                    "turbulence must be a spectrum, FrozenFlows, ModalTurbulence or None, or a "
                    f"sequence of these; got {type(part).__name__}."
                )
        return out

    def _each_turbulence(self, modes: int) -> tuple[Any, ...]:
        """Return the turbulence as it was given per mode, or for each of some modes."""
        given = self.turbulence
        return tuple(given) if isinstance(given, Sequence) else (given,) * modes

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
        n, each = hardware.modes, self._each_turbulence(hardware.modes)
        if len(each) != n:
            raise DimensionError(f"turbulence must have one entry per mode ({n}); got {len(each)}.")
        found: dict[object, tuple[Turbulence, tuple[int, ...]]] = {}
        for mode, part in enumerate(each):
            if part is not None:
                first, modes = found.get(spectrum_key(part), (part, ()))
                found[spectrum_key(part)] = (first, (*modes, mode))
        return list(found.values())

    def distinct(self, hardware: LoopHardware, *, apart: bool) -> tuple[IntArray, IntArray]:
        """Return rows that differ by more than their vibrations, and which of them each loop has.

        With ``apart`` all rows differ, as each has its own controller.
        """
        rows = np.arange(self.loops)
        if apart:
            return rows, rows
        columns = [self.gains(), self.delays(hardware), *self.noise(hardware).T]
        for part, _ in self.groups(hardware):
            if isinstance(part, FrozenFlows) and len(part) > 1:
                columns += [part.seeing_arcsec, part.wind_speed_m_s]
                columns += [] if part.outer_scale_m is None else [part.outer_scale_m]
            elif isinstance(part, ModalTurbulence) and part.n_modes > 1:
                columns += [*part.coefficients.T, part.driving_rms_nm]
        varying = [column for column in columns if np.ptp(column) > 0]
        if not varying:
            return rows[:1], np.zeros(self.loops, dtype=np.int64)
        if any(np.unique(column).size == self.loops for column in varying):
            return rows, rows
        table = np.stack(varying, axis=1)
        _, first, which = np.unique(table, axis=0, return_index=True, return_inverse=True)
        return (rows, rows) if first.size == self.loops else (first, which.reshape(-1))

    def lines(self, hardware: LoopHardware) -> list[EnsembleVibration]:
        """Return the vibrations with all their arrays (p,), and directions (p, n)."""
        out, p, nyquist = [], self.loops, hardware.frame_rate_hz / 2
        for line in self.vibrations:
            if line.direction.shape[-1] != hardware.modes:
                wanted = f"{hardware.modes} components, one per mode"
                got = line.direction.shape[-1]
                raise DimensionError(f"the direction of a vibration must have {wanted}; got {got}.")
            if not np.max(line.frequency_hz) < nyquist:
                limit, got = f"the Nyquist frequency {nyquist:.6g} Hz", np.max(line.frequency_hz)
                raise ProblemError(f"a vibration must lie below {limit}; got {got:.6g} Hz.")
            given = {name: getattr(line, name) for name in ("frequency_hz", "rms_nm", "damping")}
            filled = {k: np.broadcast_to(v, (p,)) for k, v in given.items() if v is not None}
            direction = np.broadcast_to(line.direction, (p, hardware.modes))
            out.append(replace(line, **filled, direction=direction))
        return out


def turbulence_rows(turbulence: Turbulence, rows: IntArray) -> Turbulence:
    """Return the turbulence of some loops."""
    if isinstance(turbulence, FrozenFlows) and len(turbulence) > 1:
        return turbulence.take(rows)
    if isinstance(turbulence, ModalTurbulence) and turbulence.n_modes > 1:
        a, driving = turbulence.coefficients[rows], turbulence.driving_rms_nm[rows]
        return replace(turbulence, coefficients=a, driving_rms_nm=driving)
    return turbulence
