"""Optimised modal gains from telemetry: the spectrum of the pseudo-open-loop measurement.

What is estimated is the spectrum of the difference of two frames. Turbulence falls so steeply
that a periodogram of the phase itself leaks, and misses what lies below its first frequency;
that of the difference is flat there, and reaches down to 0. The
rejection ``|1 - z^-1|^2 / |1 - z^-1 + h z^-1 M|^2`` loses its numerator then.

The periodogram scatters about the spectrum, also where there is nothing but noise: the noise is
therefore taken out with its sign. Scatter of both signs averages out in the residual's variance;
cut off at zero it would add up to turbulence over the whole band.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import welch

from lbt_synth.design.modal.gains import ModalGains, find_gains
from lbt_synth.design.modal.per_mode import number_per_mode
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import FloatArray, integer, real_array

_QUIET = 0.4  # of the frame rate, above which the noise is found


def modal_gains_from_telemetry(
    measurements: ArrayLike,
    commands: ArrayLike,
    *,
    frame_rate_hz: float,
    noise_nm: ArrayLike | None = None,
    delay_frames: float = 2.0,
    sensor_gain: ArrayLike = 1.0,
    margin: float = 0.001,
    segment_frames: int = 1024,
    mirror: PositionLoop | None = None,
) -> ModalGains:
    """Find the integrator gain of least residual for every mode, from a running loop.

    Measurements and commands of the closed loop give the pseudo-open-loop measurement
    ``y(k) + sensor_gain phi_cor(k-1)``, with ``phi_cor`` the mirror's correction. The
    periodogram (Welch) of its differences, less that of the noise, is the spectrum.

    Parameters
    ----------
    measurements, commands : (frames, n) array_like
        Modal measurements y(k) and commands u(k) [nm], one row per frame as in telemetry.
    frame_rate_hz : float
        Frame rate [Hz].
    noise_nm : float or (n,) array_like, optional
        Measurement noise per frame [nm]; by default the mean of the periodogram's upper
        fifth, where there should be nothing but noise: turbulence that reaches up there makes
        the noise too large and the residuals too small, and does not change the gains.
    delay_frames : float, optional
        Total delay of the loop [frames], at least 1, fractions allowed.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain of each mode, known.
    margin : float, optional
        Distance from the stability limit as a part of it, as for :func:`modal_gains`.
    segment_frames : int, optional
        Length of the periodogram's segments [frames], at least 16.
    mirror : PositionLoop, optional
        Dynamics of the mirror, the same for all modes; one that settles at once by default.

    Returns
    -------
    ModalGains
        The gains, and what they leave.

    Raises
    ------
    ProblemError
        If a value is out of its range or not finite, sizes clash, or the series are shorter
        than a segment.

    Notes
    -----
    The gains hardly depend on the noise, given or found: it moves what is called residual by the
    same amount at every gain. The squared residual scatters, with both signs, by about
    ``noise_nm**2 sqrt(2 / frames)`` over the sensor gain squared from the noise alone, twice that
    where the noise is found, and by what the turbulence scatters itself: 4.1 nm behind 15.5 nm
    of noise have a standard deviation of 1.0 nm after 2048 frames and 0.24 nm after 40 000. A
    residual is at least the noise that the loop lets through.

    Gains below some ``2 pi / segment_frames`` are beyond the resolution of the periodogram: a mode
    that is best left alone may get one of that size. Longer segments resolve them.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> rng = np.random.default_rng(0)
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> walk = lbt.loop.Disturbance(
    ...     phase_nm=0.99 * np.cumsum(rng.standard_normal((20_000, 1)), axis=0),
    ...     noise=5.0 * rng.standard_normal((20_000, 1)),
    ... )
    >>> run = lbt.simulate(lbt.integrator(path, gain=0.3), walk, hardware=path)
    >>> found = lbt.design.modal.modal_gains_from_telemetry(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=800
    ... )
    >>> bool(abs(found.noise_nm[0] - 5) < 0.5), bool(0.1 < found.gains[0] < 0.25)
    (True, True)
    """
    path = LoopHardware(
        frame_rate_hz=frame_rate_hz, delay_frames=delay_frames, modes=1, mirror=mirror
    )
    rate, taps = path.frame_rate_hz, path.mirror_taps
    y, u = real_array(measurements, "measurements"), real_array(commands, "commands")
    if y.ndim != 2 or y.shape != u.shape or y.size == 0:
        raise DimensionError(
            f"measurements and commands must both be (frames, modes); got {y.shape} and {u.shape}."
        )
    y, u = y.T, u.T
    count, frames = y.shape
    segment = integer(segment_frames, "segment_frames", at_least=16)
    gain = number_per_mode(sensor_gain, "sensor_gain", count)
    first = len(taps)  # frame whose correction is known
    if frames - first <= segment:
        raise ProblemError(
            f"the series must be longer than a segment, {segment} frames and {first} of delay and "
            f"mirror; got {frames}. Record more, or shorten segment_frames."
        )
    open_loop = y[:, first:] / gain[:, None] + past_corrections(taps, u.T)[first:].T
    steps = np.diff(open_loop, axis=1)
    frequency, power = welch(steps, rate, nperseg=segment, detrend=False)
    power[:, 0] *= 2  # one-sided as the others
    if segment % 2 == 0:
        power[:, -1] *= 2
    # exact mean of the periodogram for differences of white noise of 1 nm
    window = np.hanning(segment + 1)[:-1]
    neighbours = window[1:] @ window[:-1] / (window @ window)
    unit = 4 / rate * (1 - neighbours * np.cos(2 * np.pi * frequency / rate))
    if noise_nm is None:
        quiet = frequency > _QUIET * rate
        noise = np.sqrt(np.mean(power[:, quiet] / unit[quiet], axis=1)) * gain
    else:
        noise = number_per_mode(noise_nm, "noise_nm", count, zero=True)
    table = power - np.outer((noise / gain) ** 2, unit)

    def density(wanted: FloatArray) -> FloatArray:
        left = np.clip(np.searchsorted(frequency, wanted) - 1, 0, frequency.size - 2)
        part = np.clip((wanted - frequency[left]) / np.diff(frequency)[left], 0.0, 1.0)
        return np.asarray(table[:, left] * (1 - part) + table[:, left + 1] * part)

    known: dict[str, FloatArray] = {"noise_nm": noise, "gain": gain}
    edges = 2 * frequency / rate
    return find_gains(path, density, edges, **known, margin=margin, differenced=True)
