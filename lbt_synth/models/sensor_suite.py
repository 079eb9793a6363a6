"""Sensors beside the loop's own: wavefront sensors of other rates, and accelerometers.

The delay of a sensor counts as that of a loop does: from the beginning of what it measures to the
frame in which a command computed from it acts, in periods of the sensor. In frames of the loop a
reading is therefore ``age = delay_frames * period - (d - 1)`` old, with d the loop's total delay:
the loop's own sensor, of delay d and period 1, has the age 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import (
    BoolArray,
    ComplexArray,
    FloatArray,
    Positive,
    check_fields,
    definite,
    frozen_copy,
    matrix,
    one_or_each,
    set_fields,
)

if TYPE_CHECKING:
    from lbt_synth.models.loop_hardware import LoopHardware

OWN_SENSOR = "wavefront"
LONGEST_PERIOD = 1000  # frames of the loop per reading
LONGEST_DELAY = 100  # of a sensor [its periods]
WHOLE = 1e-9  # relative amount by which a ratio of rates may miss a whole number


def noise_factor(noise_nm: Any, q: int) -> FloatArray:
    """Return the square root (q, q) of the noise covariance, from deviations or the covariance."""
    if np.ndim(noise_nm) < 2:
        deviations = one_or_each(noise_nm, "noise_nm", q, above=0)
        return frozen_copy(np.diag(np.broadcast_to(deviations, q)))
    covariance = definite(noise_nm, "noise_nm", size=(q, "to match the measurements"))
    return frozen_copy(np.linalg.cholesky(covariance))


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How an accelerometer moves with a vibration, at the vibration's frequency.

    Parameters
    ----------
    size : float
        Motion of the channel per motion of the wavefront [nm per nm rms].
    phase_deg : float, optional
        Phase of the channel's motion against the wavefront's [deg].

    Examples
    --------
    >>> from lbt_synth.models.sensor_suite import Motion
    >>> Motion(size=2.0, phase_deg=180).factor.real
    -2.0
    """

    size: Positive
    phase_deg: Annotated[float, ("at_least", -360), ("at_most", 360)] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def factor(self) -> complex:
        """Complex motion of the channel per motion of the wavefront."""
        return complex(self.size * np.exp(1j * np.deg2rad(self.phase_deg)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WavefrontSensor:
    """A second sensor of the residual phase, averaged over each of its periods.

    ``y = sensor_matrix (mean of phi_res over the period) + noise``.

    Parameters
    ----------
    name : str
        Its name.
    rate_hz : float
        Readings per second [Hz]; the loop's frame rate is a whole multiple of it.
    delay_frames : float
        Total delay in its own periods, at least 1.
    noise_nm : float, (q,) or (q, q) array_like
        Standard deviation of the noise of a reading [nm], or its covariance [nm^2].
    sensor_matrix : (q, n) array_like, optional
        Response to the modes; the identity by default.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> from lbt_synth.models.sensor_suite import WavefrontSensor
    >>> WavefrontSensor(name="truth", rate_hz=50, delay_frames=3, noise_nm=4.0).units
    ('truth',)
    """

    name: str
    rate_hz: Positive
    delay_frames: Annotated[float, ("at_least", 1), ("at_most", LONGEST_DELAY)]
    noise_nm: float | FloatArray
    sensor_matrix: FloatArray | None = None

    def __post_init__(self) -> None:
        response = (
            None if self.sensor_matrix is None else matrix(self.sensor_matrix, "sensor_matrix")
        )
        check_fields(self, sensor_matrix=response)

    @property
    def units(self) -> tuple[str, ...]:
        """Names of what fails as one: the sensor itself."""
        return (self.name,)

    def response(self, modes: int) -> FloatArray:
        """Sensor matrix over the modes of a loop, (q, n)."""
        if self.sensor_matrix is None:
            return np.eye(modes)
        if self.sensor_matrix.shape[1] != modes:
            raise DimensionError(
                f"the matrix of sensor {self.name} must have {modes} columns, one per mode; got "
                f"{self.sensor_matrix.shape}."
            )
        return self.sensor_matrix

    def noise_factor(self, modes: int) -> FloatArray:
        """Square root of the noise covariance, (q, q) [nm]."""
        return noise_factor(self.noise_nm, len(self.response(modes)))

    def age_frames(self, hardware: LoopHardware) -> float:
        """Age of the oldest frame that a reading averages [frames of the loop]."""
        return _age(self, hardware, least=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accelerometer:
    """Channels that measure the acceleration of structures which vibrate.

    Channel c reads ``a_c = 1e-9 sum_j F_cj a_j`` [m/s^2], with ``a_j`` the mean acceleration of
    vibration j [nm/s^2] over the period that the reading measures, and F_cj its :class:`Motion`
    with the channel.

    Parameters
    ----------
    name : str
        Name of the instrument.
    rate_hz : float
        Readings per second [Hz]; the loop's frame rate is a whole multiple of it.
    delay_frames : float
        Total delay in its own periods, at least 1.
    channels : tuple of str
        Names of the channels.
    noise_m_s2 : float, (c,) or (c, c) array_like
        Standard deviation of the noise of a reading [m/s^2], or its covariance.
    highpass_hz : float, optional
        Corner of the first-order high pass of each channel [Hz]; its gain and phase at each line
        multiply the motion.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range, or two channels share a name.

    Examples
    --------
    >>> from lbt_synth.models.sensor_suite import Accelerometer
    >>> mirror = Accelerometer(
    ...     name="mirror", rate_hz=1000, delay_frames=1, channels=("m1", "m2"), noise_m_s2=2e-4
    ... )
    >>> mirror.units
    ('m1', 'm2')
    """

    name: str
    rate_hz: Positive
    delay_frames: Annotated[float, ("at_least", 1), ("at_most", LONGEST_DELAY)]
    channels: tuple[str, ...]
    noise_m_s2: float | FloatArray
    highpass_hz: Positive | None = None

    def __post_init__(self) -> None:
        channels = tuple(self.channels)
        if not channels or len(set(channels)) < len(channels):
            raise ProblemError(
                f"channels of {self.name} must be different names, at least one; got {channels}."
            )
        check_fields(self, channels=channels)

    @property
    def units(self) -> tuple[str, ...]:
        """Names of what fails as one: each channel."""
        return self.channels

    def noise_factor(self, modes: int) -> FloatArray:
        """Square root of the noise covariance, (c, c) [m/s^2]; the modes do not matter."""
        return noise_factor(self.noise_m_s2, len(self.channels))

    def age_frames(self, hardware: LoopHardware) -> float:
        """Age of the oldest frame that a reading averages [frames of the loop]."""
        return _age(self, hardware, least=0)

    def factor(self, motion: Motion, frequency_hz: ArrayLike) -> ComplexArray:
        """Return a channel's response at frequencies: its motion, and the high pass."""
        corner = 0.0 if self.highpass_hz is None else self.highpass_hz
        return np.asarray(motion.factor / (1 - 1j * corner / np.asarray(frequency_hz)))

    def swing(
        self, motion: Motion, frequency_hz: ArrayLike, hardware: LoopHardware
    ) -> ComplexArray:
        """Return the reading of a sinusoid over its mean position in a frame [m/s^2 per nm].

        The mean acceleration of a frame is ``-w^2`` times the mean position; a reading is the mean
        of its frames.
        """
        w = 2 * np.pi * np.asarray(frequency_hz)
        ages = self.age_frames(hardware) - np.arange(period_frames(self, hardware))
        mean = np.mean(np.exp(-1j * hardware.dt_s * np.multiply.outer(w, ages)), axis=-1)
        return np.asarray(-1e-9 * w**2 * self.factor(motion, frequency_hz) * mean)


Sensor: TypeAlias = WavefrontSensor | Accelerometer
Motions: TypeAlias = tuple[Mapping[str, Motion], ...]  # of each vibration, by channel


def period_frames(sensor: Sensor, hardware: LoopHardware) -> int:
    """Return the frames of the loop from one reading of a sensor to the next."""
    ratio = hardware.frame_rate_hz / sensor.rate_hz
    period = round(ratio)
    if not 1 <= period <= LONGEST_PERIOD or abs(ratio - period) > WHOLE * ratio:
        raise ProblemError(
            f"the frame rate {hardware.frame_rate_hz:.6g} Hz must be a whole multiple (up to "
            f"{LONGEST_PERIOD}) of the rate of sensor {sensor.name}; got {sensor.rate_hz:.6g} Hz. "
            "Average its readings to such a rate."
        )
    return period


def _age(sensor: Sensor, hardware: LoopHardware, *, least: int) -> float:
    """Return the age of the oldest frame that a reading averages; the newest is at least so old."""
    period, late = period_frames(sensor, hardware), hardware.delay_frames - 1
    age = sensor.delay_frames * period - late
    if age - period + 1 < least - WHOLE:
        raise ProblemError(
            f"the delay of sensor {sensor.name} must be at least "
            f"{(period + late + least - 1) / period:.4g} of its frames, so that its exposure has "
            f"ended when it is read; got {sensor.delay_frames:g}."
        )
    return float(round(age)) if abs(age - round(age)) < WHOLE * period else age


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorSuite:
    """The sensors beside the loop's own, with names that differ.

    Parameters
    ----------
    sensors : tuple of WavefrontSensor and Accelerometer
        None by default; wavefront sensors become the first, as their measurements are.

    Examples
    --------
    >>> from lbt_synth.models.sensor_suite import SensorSuite, WavefrontSensor
    >>> slow = WavefrontSensor(name="truth", rate_hz=50, delay_frames=3, noise_nm=4.0)
    >>> SensorSuite(sensors=(slow,)).units
    ('wavefront', 'truth')
    """

    sensors: tuple[Sensor, ...] = ()
    units: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        # in the order of their measurements
        sensors = tuple(sorted(self.sensors, key=lambda each: isinstance(each, Accelerometer)))
        units = (OWN_SENSOR, *(unit for sensor in sensors for unit in sensor.units))
        if len(set(units)) < len(units):
            raise ProblemError(
                f"sensors and channels must have different names, none of them {OWN_SENSOR!r}; "
                f"got {', '.join(units[1:])}."
            )
        set_fields(self, sensors=sensors, units=units)

    def is_same(self, other: SensorSuite) -> bool:
        """Whether both have the same sensors, in all that they are."""
        return self.units == other.units and all(
            type(one) is type(two)
            and all(np.array_equal(getattr(one, f.name), getattr(two, f.name)) for f in fields(one))
            for one, two in zip(self.sensors, other.sensors, strict=True)
        )

    @property
    def wavefront(self) -> tuple[WavefrontSensor, ...]:
        """The wavefront sensors."""
        return tuple(s for s in self.sensors if isinstance(s, WavefrontSensor))

    @property
    def accelerometers(self) -> tuple[Accelerometer, ...]:
        """The accelerometers."""
        return tuple(s for s in self.sensors if isinstance(s, Accelerometer))

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all accelerometer channels."""
        return tuple(name for sensor in self.accelerometers for name in sensor.channels)

    def period(self, hardware: LoopHardware) -> int:
        """Return the common period of all sensors [frames of the loop]."""
        period = int(np.lcm.reduce([1, *(period_frames(s, hardware) for s in self.sensors)]))
        if period > LONGEST_PERIOD:
            raise ProblemError(
                f"the common period of the sensors must be at most {LONGEST_PERIOD} frames; got "
                f"{period}. Choose rates of which one divides the other."
            )
        return period

    def later(self, frames: int, hardware: LoopHardware) -> SensorSuite:
        """Return the same readings for a loop whose commands act some frames later."""
        delays = [s.delay_frames + frames / period_frames(s, hardware) for s in self.sensors]
        pairs = zip(self.sensors, delays, strict=True)
        return SensorSuite(sensors=tuple(replace(s, delay_frames=delay) for s, delay in pairs))

    def rows(self, hardware: LoopHardware) -> dict[str, slice]:
        """Return which measurements each unit gives: the loop's own, wavefront, channels."""
        sizes = {OWN_SENSOR: hardware.n_measurements}
        sizes |= {s.name: len(s.response(hardware.modes)) for s in self.wavefront}
        sizes |= dict.fromkeys(self.channels, 1)
        ends = np.cumsum([0, *sizes.values()]).tolist()
        return {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(sizes)}

    def marked(self, units: tuple[str, ...], hardware: LoopHardware) -> BoolArray:
        """Return which measurements some sensors or channels give, (q,)."""
        rows = self.rows(hardware)
        out = np.zeros(max(place.stop for place in rows.values()), dtype=np.bool_)
        for unit in units:
            if unit not in rows:
                raise ProblemError(
                    f"no sensor or channel is called {unit!r}; there are {', '.join(self.units)}."
                )
            out[rows[unit]] = True
        return out

    def noise_factor(self, own: FloatArray, modes: int) -> FloatArray:
        """Return the square root of all noise, from that of the loop's own sensor, (q, q)."""
        return np.asarray(block_diag(own, *(sensor.noise_factor(modes) for sensor in self.sensors)))

    def read(self, hardware: LoopHardware) -> BoolArray:
        """Return which measurements are read in each frame of the common period, (N, q)."""
        rows, period = self.rows(hardware), self.period(hardware)
        out = np.tile(self.marked((OWN_SENSOR,), hardware), (period, 1))
        for sensor in self.sensors:
            for unit in sensor.units:
                out[:: period_frames(sensor, hardware), rows[unit]] = True
        return out


OWN_SENSOR_ALONE = SensorSuite()


def checked_motions(motions: Motions, suite: SensorSuite, lines: int) -> Motions:
    """Return the motions of each vibration, which must name channels that exist."""
    if len(motions) != lines:
        raise DimensionError(
            f"motions must be one mapping per vibration ({lines}); got {len(motions)}."
        )
    for motion in motions:
        for name in motion:
            if name not in suite.channels:
                raise ProblemError(
                    f"a vibration names the channel {name!r}; the channels are "
                    f"{', '.join(suite.channels) or 'none'}."
                )
    return tuple(dict(motion) for motion in motions)
