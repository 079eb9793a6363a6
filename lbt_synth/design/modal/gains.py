"""Optimised modal gains: the integrator gain of least residual for every mode.

E. Gendron, P. Lena, Astron. Astrophys. 291, 337 (1994). All modes see the same delay, so with
the loop gain ``h = sensor_gain * gain`` they have the same transfer functions: the residual of
every mode at every loop gain of a grid is one product of matrices, spectra by rejections. Between
the grid's points the residual, times its distance from the stability limit, is a polynomial.

What telemetry gives is the spectrum of the difference of two frames. Turbulence falls so steeply
that a periodogram of the phase itself leaks, and misses what lies below its first frequency; that
of the difference is flat there, and reaches down to 0. The rejection ``|1 - z^-1|^2 / |1 - z^-1 + h
z^-1 M|^2`` loses its numerator then. The periodogram scatters about the spectrum, also where there
is nothing but noise: the noise is therefore taken out with its sign, as scatter of both signs
averages out in the residual's variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import ArrayLike
from scipy.special import comb

from lbt_synth.design.integrator import PURE, TRIED_GAINS, integrator_gain_limit
from lbt_synth.design.modal.stack import Vibrations, lines_per_mode, number_per_mode
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.linear.quadrature import gauss_panels, graded_edges
from lbt_synth.loop.evaluator import close_loops, textbook_matrices
from lbt_synth.models import ARModel, LoopHardware, Spectrum
from lbt_synth.models.loop_hardware import past_corrections, require_loop_rate
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    integer,
    number,
    read_only,
    real_array,
    require_instance,
)

Density = Callable[[FloatArray], FloatArray]

_GRID = 161  # loop gains
_HIGHEST = 0.9999  # end of the grid, as a part of the stability limit
_RESONANT = 1 - np.geomspace(0.7, 1e-3, 7)  # parts of it whose resonance is resolved
_WINDOW = 10  # points that a polynomial interpolates
_GOLDEN = (np.sqrt(5) - 1) / 2
_STEPS = 45  # golden sections, to 1e-9 of the bracket
_NODES = 6  # per panel
_HALVINGS = 8
_SETTLED = 1e-6  # relative change of variances by the last halving
_QUIET = 0.4  # of the frame rate, above which telemetry shows nothing but noise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalGains:
    """Integrator gains of least residual."""

    # (n,): integrator gain of each mode. 1e-4 of the stability limit is the least that is tried: a
    # mode that has it is better left alone
    gains: FloatArray
    rms_nm: FloatArray  # (n,): residual that they leave in the image [nm rms]
    # (n,): largest gain that was allowed: the margin below the stability limit, at unit sensor gain
    # and at the mode's own
    limit: FloatArray
    limited: BoolArray  # (n,): whether the gain is at that limit
    noise_nm: FloatArray  # (n,): measurement noise that was given or found [nm]


def modal_gains(
    spectra: ARModel | Sequence[Spectrum],
    *,
    hardware: LoopHardware,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    sensor_gain: ArrayLike = 1.0,
    margin: float = 0.001,
) -> ModalGains:
    """Find the integrator gain of least residual for every mode, from spectra.

    Parameters
    ----------
    spectra : ARModel or sequence of Spectrum
        Spectrum of each mode's phase: models, an Atmosphere, tables.
    hardware : LoopHardware
        Delay, mirror and frame rate of all modes; its matrices play no part.
    noise_nm : float or (n,) array_like
        Measurement noise of each mode per frame [nm], at least 0.
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain of each mode, known.
    margin : float, optional
        Distance from the stability limit as a part of it: gains are at most ``(1 - margin)``
        times :func:`integrator_gain_limit`, and that over a sensor gain above 1.

    Returns
    -------
    ModalGains
        The gains, and what they leave.

    Raises
    ------
    ProblemError
        If a value is out of its range or sizes clash.
    NumericalError
        If the integral over a spectrum does not settle.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> modes = lbt.models.modal_turbulence(air, modes=100, frame_rate_hz=800)
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> best = lbt.design.modal.modal_gains(modes, hardware=path, noise_nm=15.5)
    >>> best.gains[[0, 50, 99]].round(3).tolist()
    [0.456, 0.304, 0.212]
    """
    path = require_instance(hardware, LoopHardware, "hardware").single_mode()
    rate = path.frame_rate_hz
    densities, count, edges = _spectra_per_mode(spectra, path)
    lines = lines_per_mode(vibrations, count)
    models = [(mode, line.ar_model(rate)) for mode, own in enumerate(lines) for line in own]

    def density(frequency: FloatArray) -> FloatArray:
        out = densities(frequency)
        for mode, model in models:
            out[mode] += model.psd(frequency)
        return out

    edges += [_model_edges(model) for _, model in models]
    noise = number_per_mode(noise_nm, "noise_nm", count, at_least=0)
    gain = number_per_mode(sensor_gain, "sensor_gain", count, above=0)
    panels = np.concatenate(edges)
    return _find_gains(path, density, panels, noise_nm=noise, gain=gain, margin=margin)


def modal_gains_from_telemetry(
    measurements: ArrayLike,
    commands: ArrayLike,
    *,
    hardware: LoopHardware,
    noise_nm: ArrayLike | None = None,
    sensor_gain: ArrayLike = 1.0,
    margin: float = 0.001,
    segment_frames: int = 1024,
) -> ModalGains:
    """Find the integrator gain of least residual for every mode, from a running loop.

    Measurements and commands of the closed loop give the pseudo-open-loop measurement
    ``y(k) + sensor_gain phi_cor(k-1)``, with ``phi_cor`` the mirror's correction. The
    periodogram (Welch) of its differences, less that of the noise, is the spectrum.

    Parameters
    ----------
    measurements, commands : (frames, n) array_like
        Modal measurements y(k) and commands u(k) [nm], one row per frame as in telemetry.
    hardware : LoopHardware
        Delay, mirror and frame rate of all modes; its matrices play no part.
    noise_nm : float or (n,) array_like, optional
        Measurement noise per frame [nm]; by default the mean of the periodogram's upper
        fifth, where there should be nothing but noise: turbulence that reaches up there makes
        the noise too large and the residuals too small, and does not change the gains.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain of each mode, known.
    margin : float, optional
        Distance from the stability limit as a part of it, as for :func:`modal_gains`.
    segment_frames : int, optional
        Length of the periodogram's segments [frames], at least 16.

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
    >>> best = lbt.design.modal.modal_gains_from_telemetry(
    ...     run.measurements[0], run.commands[0], hardware=path
    ... )
    >>> bool(abs(best.noise_nm[0] - 5) < 0.5), bool(0.1 < best.gains[0] < 0.25)
    (True, True)
    """
    from scipy.signal import welch  # slow to import

    path = require_instance(hardware, LoopHardware, "hardware").single_mode()
    rate, taps = path.frame_rate_hz, path.mirror_taps
    y, u = real_array(measurements, "measurements"), real_array(commands, "commands")
    if y.ndim != 2 or y.shape != u.shape or y.size == 0:
        raise DimensionError(
            f"measurements and commands must both be (frames, modes); got {y.shape} and {u.shape}."
        )
    y, u = y.T, u.T
    count, frames = y.shape
    segment = integer(segment_frames, "segment_frames", at_least=16)
    gain = number_per_mode(sensor_gain, "sensor_gain", count, above=0)
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
        noise = number_per_mode(noise_nm, "noise_nm", count, at_least=0)
    table = power - np.outer((noise / gain) ** 2, unit)

    def density(wanted: FloatArray) -> FloatArray:
        left = np.clip(np.searchsorted(frequency, wanted) - 1, 0, frequency.size - 2)
        part = np.clip((wanted - frequency[left]) / np.diff(frequency)[left], 0.0, 1.0)
        return np.asarray(table[:, left] * (1 - part) + table[:, left + 1] * part)

    known: dict[str, FloatArray] = {"noise_nm": noise, "gain": gain}
    edges = 2 * frequency / rate
    return _find_gains(path, density, edges, **known, margin=margin, differenced=True)


def _spectra_per_mode(
    spectra: ARModel | Sequence[Spectrum], path: LoopHardware
) -> tuple[Density, int, list[FloatArray]]:
    """Return spectra of means (n, f) as a function, n, and edges of panels over the Nyquist one."""
    if isinstance(spectra, ARModel):
        require_loop_rate(spectra.frame_rate_hz, path)
        return ARModel.stack(spectra).psd, spectra.count, [_model_edges(spectra)]
    each = tuple(spectra) if isinstance(spectra, Sequence) else ()
    if not each or not all(isinstance(spectrum, Spectrum) for spectrum in each):
        raise ProblemError(
            "spectra must be an ARModel, or a list with one spectrum per mode (objects with "
            f"psd(frequency_hz)); got {type(spectra).__name__}."
        )
    distinct, rate = {id(spectrum): spectrum for spectrum in each}, path.frame_rate_hz
    edges = [breakpoints_below(spectrum, rate / 2) * 2 / rate for spectrum in distinct.values()]
    for spectrum in distinct.values():
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, path)
            edges.append(_model_edges(spectrum))

    def evaluate(frequency: FloatArray) -> FloatArray:
        known = {i: np.asarray(one.psd(frequency), np.float64) for i, one in distinct.items()}
        for i, one in distinct.items():
            if not isinstance(one, ARModel):  # of means already
                known[i] = known[i] * np.sinc(frequency / rate) ** 2
        return np.stack([known[id(one)] for one in each])

    return evaluate, len(each), edges


def _model_edges(model: ARModel) -> FloatArray:
    return graded_edges(np.linalg.eigvals(model.companion).ravel().astype(np.complex128))


def _checked_spectra(
    density: Density, frequency_hz: FloatArray, *, differenced: bool
) -> FloatArray:
    """Return the spectra (n, f); refuse what is not finite, or negative unless differenced."""
    spectra = density(frequency_hz)
    sound = np.isfinite(spectra) & ((spectra >= 0) | differenced)
    wrong = np.flatnonzero(~sound.all(axis=1))
    if wrong.size:
        which = f"that of mode {wrong[0]} is not"
        raise ProblemError(f"every spectrum must be finite and at least 0; {which}.")
    return spectra


def _find_gains(
    path: LoopHardware,
    density: Density,
    edges: FloatArray,  # of panels, over the Nyquist frequency
    *,
    noise_nm: FloatArray,
    gain: FloatArray,  # (n,): of the sensor
    margin: float,
    differenced: bool = False,  # whether spectra are those of differences of two means
) -> ModalGains:
    """Find the gains on finer and finer panels, until residuals and gains no longer change."""
    least, most = TRIED_GAINS
    rate, limit = path.frame_rate_hz, integrator_gain_limit(path)
    noise_nm2 = (noise_nm / gain) ** 2
    distance = number(margin, "margin", at_least=round(1 - most, 9), below=1)
    loop_gains = np.geomspace(least, _HIGHEST, _GRID) * limit
    highest = (1 - distance) * limit * np.minimum(gain, 1.0)
    if np.any(highest < loop_gains[_WINDOW]):
        raise ProblemError(
            "margin and sensor_gain must leave room for a gain; got gains of at most "
            f"{np.min(highest / gain):.3g} at a sensor gain of {np.min(gain):.3g}."
        )
    unit = textbook_matrices([PURE.controller(path, 1.0)])
    delays = np.full(loop_gains.size, path.delay_frames)
    _, ((_, (loops,)),) = close_loops(unit, path, loop_gains, delays)
    # of unit noise over the sensor gain
    propagated = loops.of_noise(np.ones((1, 1, 1))).sum(axis=(1, 2, 3)) * loop_gains**2
    # the poles of a loop are the roots of 1 - z^-1 + h z^-1 M, in powers of z^-1
    path_taps = np.append(0.0, path.mirror_taps)
    poles = [np.roots(polyadd([1.0, -1.0], part * limit * path_taps)) for part in _RESONANT]
    resonances = np.concatenate([root.ravel() for root in poles]).astype(np.complex128)
    edges = np.union1d(graded_edges(resonances), edges)
    last = np.full((2, gain.size), np.inf)  # gains and variances
    for _ in range(_HALVINGS):
        nodes, weights = gauss_panels(edges * rate / 2, _NODES)
        rejection = loops.powers(np.ones((1, 1, 1)))(nodes).sum(axis=(0, 1, 2)).T
        rejection /= np.sinc(nodes / rate) ** 2  # the spectra are of means over frames
        if differenced:
            rejection /= 4 * np.sin(np.pi * nodes / rate) ** 2
        spectra = _checked_spectra(density, nodes, differenced=differenced)
        variances = (spectra * weights) @ rejection.T + np.outer(noise_nm2, propagated)
        if np.any(variances[:, 0] == 0):
            raise ProblemError(
                "every mode must have turbulence, vibration or noise; got none in mode "
                f"{int(np.argmin(variances[:, 0]))}."
            )
        best, variance = _minimise(loop_gains, variances, limit, highest)
        if differenced:
            floor = noise_nm2 * np.interp(best, loop_gains, propagated)
            variance = np.maximum(variance, floor)
        change = np.max(np.abs(np.stack([best, variance]) / last - 1), axis=1)
        if change[0] < 1e-4 and change[1] < _SETTLED:
            break
        last[:] = best, variance
        edges = np.union1d(edges, (edges[1:] + edges[:-1]) / 2)
    else:
        raise NumericalError(
            "the integral over a spectrum did not settle: residuals change still after "
            f"{_HALVINGS} halvings of all panels. Check that no spectrum is a set of lines; give a "
            "table its own frequencies.",
            status="quadrature",
        )
    allowed = highest / gain
    gains = np.minimum(best / gain, allowed)
    return ModalGains(
        gains=read_only(gains),
        rms_nm=read_only(np.sqrt(variance)),
        limit=read_only(allowed),
        limited=read_only(gains > allowed * (1 - 1e-6)),
        noise_nm=noise_nm,
    )


def _minimise(
    loop_gains: FloatArray, variances: FloatArray, limit: float, highest: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the loop gain of least variance of each mode, up to the highest, and that variance."""
    step = np.log(loop_gains[1] / loop_gains[0])
    top = np.log(highest / loop_gains[0]) / step  # place on the grid, a fraction
    allowed = np.arange(loop_gains.size) <= top[:, None] + 1e-9
    best = np.argmin(np.where(allowed, variances, np.inf), axis=1)
    first = np.clip(best - _WINDOW // 2, 0, loop_gains.size - _WINDOW)
    window = first[:, None] + np.arange(_WINDOW)
    smooth = np.take_along_axis(variances * (1 - loop_gains / limit), window, axis=1)
    factors = (-1.0) ** np.arange(_WINDOW) * comb(_WINDOW - 1, np.arange(_WINDOW))

    def variance(place: FloatArray) -> FloatArray:
        apart = (place - first)[:, None] - np.arange(_WINDOW)
        apart = np.where(np.abs(apart) < 1e-12, 1e-12, apart)
        weight = factors / apart
        value = np.sum(weight * smooth, axis=1) / np.sum(weight, axis=1)
        return np.asarray(value / (1 - loop_gains[0] * np.exp(step * place) / limit))

    low, high = np.maximum(best - 1.0, 0.0), np.minimum(best + 1.0, top)
    for _ in range(_STEPS):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        lower = variance(left) < variance(right)
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    place = (low + high) / 2
    end = variance(top) <= variance(place)
    place = np.where(end & (top <= best + 1.0), top, place)
    return loop_gains[0] * np.exp(step * place), variance(place)
