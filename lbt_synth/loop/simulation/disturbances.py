"""Random series of a truth's disturbances and noise, stationary from their first frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len

from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models import ARModel, DriftingVibration, LoopHardware, Spectrum, Truth, Vibration
from lbt_synth.models.plant.seen_vibration import SeenVibration, seen_vibration
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.vibration import checked_direction
from lbt_synth.validation import FloatArray

# A spectrum is drawn over this many times the wanted frames, which hides the series' period.
_PERIODS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnLine:
    """A vibration of a run."""

    motion: FloatArray  # (cases, frames): mean position in each frame [nm]
    # (cases, 1 + frames, 3): of an oscillator, unit white noise of the state before the first
    # frame, and of each frame
    drive: FloatArray | None = None


def draw_disturbance(
    truth: Truth,
    hardware: LoopHardware,
    *,
    frames: int,
    cases: int,
    rng: np.random.Generator,
    zero_frame: int = 0,
    oscillators: bool = False,
) -> FloatArray:
    """Draw the total phase, (cases, frames, n) [nm].

    Each part has its own random stream: a truth with one more vibration keeps its turbulence.
    So has each mode where the modes have different spectra. Time 0 of a vibration that drifts is
    frame ``zero_frame``. Resonances are AR2 processes; with ``oscillators`` those that channels
    of the truth see are continuous oscillators.
    """
    total, lines = draw_parts(
        truth,
        hardware,
        frames=frames,
        cases=cases,
        rng=rng,
        zero_frame=zero_frame,
        oscillators=oscillators,
    )
    for vibration, line in zip(truth.vibrations, lines, strict=True):
        total += line.motion[:, :, None] * checked_direction(vibration, hardware)
    return total


def draw_parts(
    truth: Truth,
    hardware: LoopHardware,
    *,
    frames: int,
    cases: int,
    rng: np.random.Generator,
    zero_frame: int = 0,
    oscillators: bool = False,
) -> tuple[FloatArray, list[DrawnLine]]:
    """Draw the turbulence, (cases, frames, n) [nm], and each vibration."""
    n = hardware.modes
    turbulence_rng, *line_rngs = rng.spawn(1 + len(truth.vibrations))
    total, lines = np.zeros((cases, frames, n)), []
    spectra = truth.turbulence_per_mode(n)
    if truth.is_uniform and spectra[0] is not None:
        drawn = _draw(spectra[0], hardware, frames, cases * n, turbulence_rng)
        total += np.moveaxis(drawn.reshape(cases, n, frames), 1, 2)
    elif not truth.is_uniform:
        for mode, (own, mode_rng) in enumerate(zip(spectra, turbulence_rng.spawn(n), strict=True)):
            if own is not None:
                total[:, :, mode] += _draw(own, hardware, frames, cases, mode_rng)
    for vibration, seen, line_rng in zip(truth.vibrations, truth.motions, line_rngs, strict=True):
        checked_direction(vibration, hardware)
        if isinstance(vibration, Vibration) and seen and oscillators:
            alone = seen_vibration(vibration, {}, (), hardware)
            drive = line_rng.standard_normal((cases, 1 + frames, alone.B.shape[-1]))
            motion = run_oscillator(alone, vibration, drive)[:, :, 0]
            lines.append(DrawnLine(motion=motion, drive=drive))
            continue
        if isinstance(vibration, Vibration):
            model = vibration.ar_model(hardware.frame_rate_hz)
            motion = _draw_ar(model, frames, cases, line_rng)
        elif isinstance(vibration, DriftingVibration):
            time_s = (np.arange(frames) - zero_frame) / hardware.frame_rate_hz
            motion = _draw_drift(vibration, time_s, hardware.frame_rate_hz, cases, line_rng)
        else:
            turns = vibration.frequency_hz / hardware.frame_rate_hz * np.arange(frames)
            phase = line_rng.uniform(0, 2 * np.pi, (cases, 1))
            motion = vibration.amplitude_nm * np.cos(2 * np.pi * turns + phase)
        lines.append(DrawnLine(motion=motion))
    return total, lines


def run_oscillator(seen: SeenVibration, line: Vibration, drive: FloatArray) -> FloatArray:
    """Return mean positions and readings of a line, (cases, frames, 1 + c).

    The drive is (cases, 1 + frames, inputs), as that of a :class:`DrawnLine`. Exposures that begin
    before the first frame see the oscillator at rest there.
    """
    A, B, C, _ = seen.stacks()
    state = line.rms_nm * seen.still @ drive[:, 0, :2].T
    out = np.empty((drive.shape[1] - 1, C.shape[1], len(drive)))
    for k, white in enumerate(drive[:, 1:].transpose(1, 2, 0)):
        before = (k - 1) % seen.period
        state = A[before] @ state + B[before] @ white
        out[k] = C[k % seen.period] @ state
    return np.asarray(out.transpose(2, 0, 1))


def draw_noise(
    truth: Truth, hardware: LoopHardware, *, frames: int, cases: int, rng: np.random.Generator
) -> FloatArray:
    """Draw the measurement noise, (cases, frames, q) [nm]."""
    q = hardware.n_measurements
    return truth.noise_per_measurement(q) * rng.standard_normal((cases, frames, q))


def _draw(
    spectrum: Spectrum, hardware: LoopHardware, frames: int, cases: int, rng: np.random.Generator
) -> FloatArray:
    if isinstance(spectrum, ARModel):
        return _draw_ar(spectrum, frames, cases, rng)
    rate = hardware.frame_rate_hz
    length = next_fast_len(_PERIODS * frames, real=True)
    length += length % 2  # an even length has a bin at the Nyquist frequency
    # E|X_k|^2 = power_k length^2 / 2; the two end bins are real, with twice that variance
    amplitude = length * np.sqrt(_bin_powers(spectrum, rate, length)) / 2
    out = np.empty((cases, frames))
    for case in range(cases):
        white = rng.standard_normal((2, amplitude.size))
        bins = amplitude * (white[0] + 1j * white[1])
        bins[[0, -1]] = 2 * amplitude[[0, -1]] * white[0, [0, -1]]
        out[case] = irfft(bins, n=length)[:frames]
    return out


def _bin_powers(spectrum: Spectrum, rate: float, length: int) -> FloatArray:
    """Power of the spectrum in each Fourier bin [nm^2], integrated rather than sampled."""
    width = rate / length
    ends = np.concatenate([[0.0], (np.arange(length // 2) + 0.5) * width, [rate / 2]])
    inside = breakpoints_below(spectrum, rate / 2)
    # what lies below the first bin's end may rise without bound towards zero
    low = np.geomspace(1e-9, 1, 40) * ends[1]
    edges = np.unique(np.concatenate([ends, inside, low]))
    nodes, weights = gauss_panels(edges, 4)
    panels = (spectrum.psd(nodes) * weights).reshape(-1, 4).sum(axis=1)
    first = np.searchsorted(edges, ends[:-1])
    return np.asarray(np.add.reduceat(panels, first))


def _draw_drift(
    line: DriftingVibration, time_s: FloatArray, rate: float, cases: int, rng: np.random.Generator
) -> FloatArray:
    if line.damping is None:
        phase = rng.uniform(0, 2 * np.pi, (cases, 1))
        return np.asarray(line.amplitude_nm * np.cos(2 * np.pi * line.turns_at(time_s) + phase))
    a1, a2, driving = line.ar_process(time_s, rate)
    # two frames of the past at the first frequency: E x(-1) x(-2) = a1 / (1 - a2) of the variance
    together = a1[0] / (1 - a2)
    past = line.rms_nm * rng.standard_normal((2, cases))
    past[1] = together * past[0] + np.sqrt((1 - together) * (1 + together)) * past[1]
    series = driving[:, None] * rng.standard_normal((len(time_s), cases))
    older, newer = past
    for k, now in enumerate(series):
        now += a1[k] * newer + a2 * older
        older, newer = newer, series[k]
    return series.T


def _draw_ar(model: ARModel, frames: int, cases: int, rng: np.random.Generator) -> FloatArray:
    from scipy.signal import lfilter  # slow to import

    a, order = model.coefficients, model.order
    drive = np.zeros((order, order))
    drive[0, 0] = model.driving_rms_nm**2
    covariance = stationary_covariance(model.companion, drive)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    past = rng.standard_normal((cases, order)) @ root.T  # x(-1), x(-2), ...
    # lfilter's delays: zi[i] = a[i+1] x(-1) + a[i+2] x(-2) + ...
    delays = np.stack([past[:, : order - i] @ a[i:] for i in range(order)], axis=1)
    white = model.driving_rms_nm * rng.standard_normal((cases, frames))
    series, _ = lfilter([1.0], np.concatenate([[1.0], -a]), white, axis=1, zi=delays)
    return np.asarray(series)
