"""What enters a loop, frame by frame: recorded, or drawn and stationary from the first frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from lbt_synth.errors import DimensionError
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models import ARModel, LoopHardware, SinusoidalVibration, Spectrum, Truth, Vibration
from lbt_synth.models.mirror.frame_rate_system import Hold
from lbt_synth.models.plant.seen_vibration import SeenVibration, seen_vibration
from lbt_synth.models.sensor_suite import Accelerometer, Motion, checked_motions, period_frames
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.vibration import checked_direction
from lbt_synth.validation import FloatArray, float_array, number, set_fields

# A spectrum is drawn over this many times the wanted frames, which hides the series' period.
_PERIODS = 4
# a vibration of a run: its mean position in each frame (cases, frames) [nm], and of an oscillator
# unit white noise (cases, 1 + frames, 3) of the state before the first frame, and of each frame;
# others have none (cases, 1 + frames, 0)
DrawnLine: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Disturbance:
    """Phase and noise of each frame of a loop.

    Parameters
    ----------
    phase_nm : (cases, frames, n) array_like
        Mean phase over each frame [nm]; a single case may leave out its dimension.
    noise : (cases, frames, q) array_like, optional
        What the readings have beside the residual: noise, and of accelerometers the motion. Zeros
        for the loop's own sensor by default.
    sensor_gain : float, optional
        Real sensor gain relative to the sensor matrix.
    frame_means : bool, optional
        Whether the phase of a frame is one number, as in a simulator that steps by frames; nothing
        then moves within a frame. Otherwise the phase between the means is their interpolation
        below half the frame rate.

    Raises
    ------
    ProblemError
        If a number is not finite, or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> wave = 100 * np.sin(np.arange(2000.0)[:, None] / 20)
    >>> recorded = lbt.loop.Disturbance(phase_nm=wave)
    >>> run = lbt.simulate(lbt.integrator(path, gain=0.5), recorded, hardware=path)
    >>> bool(run.rms_nm[0] < 15)
    True
    """

    phase_nm: FloatArray
    noise: FloatArray | None = None
    sensor_gain: float = 1.0
    frame_means: bool = False

    def __post_init__(self) -> None:
        phase = float_array(self.phase_nm, "phase_nm")
        phase = phase[None] if phase.ndim == 2 else phase
        noise = phase if self.noise is None else float_array(self.noise, "noise")
        noise = noise[None] if noise.ndim == 2 else noise
        if phase.ndim != 3 or noise.ndim != 3 or noise.shape[:2] != phase.shape[:2]:
            raise DimensionError(
                "phase_nm must be (cases, frames, n), and noise (cases, frames, q) of as many; got "
                f"{phase.shape} and {noise.shape}."
            )
        number(self.sensor_gain, "sensor_gain", above=0)
        set_fields(self, phase_nm=phase, noise=None if self.noise is None else noise)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.phase_nm.shape[1])

    def noise_of(self, readings: int) -> FloatArray:
        """Return the noise of so many readings, (cases, frames, q)."""
        cases, frames, _ = self.phase_nm.shape
        noise = np.zeros((cases, frames, readings)) if self.noise is None else self.noise
        if noise.shape[2] != readings:
            raise DimensionError(
                f"noise must have {readings} readings a frame; got {noise.shape[2]}."
            )
        return noise

    def over_holds(self, hold: Hold) -> tuple[FloatArray, FloatArray]:
        """Return the mean phase in the pieces of holds, and the mean square within the pieces.

        They are (cases, frames, g, n), of the hold that begins in each frame, and (cases, n). A
        line from the first frame to the last is taken out of the Fourier series, and counts by
        itself; beyond the last frame the series goes on as from the first.
        """
        frames, f = self.frames, rfftfreq(self.frames)
        slope = (self.phase_nm[:, -1:] - self.phase_nm[:, :1]) / max(frames - 1, 1)
        time = np.arange(float(frames))
        bins = rfft(self.phase_nm - slope * time[:, None], axis=1)
        # from the mean over a frame, which has its phase in the middle
        late = hold.start % 1 - hold.start
        turn = np.exp(1j * np.pi * f * (2 * late - 1)) / np.sinc(f)
        means = hold.phase_means(f) * turn[:, None]
        pieces = irfft(bins[:, :, None] * means[:, :, None], n=frames, axis=1)
        middle = hold.start % 1 + (hold.edges[1:] + hold.edges[:-1] - 1) / 2
        pieces += slope[:, :, None] * (time[:, None, None] + middle[:, None])
        moving = np.maximum(1 / np.sinc(f) ** 2 - np.abs(means) ** 2 @ hold.weights, 0.0)
        moving *= np.where((f > 0) & (f < 0.5), 2.0, 1.0) / frames**2
        return np.asarray(pieces), np.asarray(np.einsum("f,cfi->ci", moving, np.abs(bins) ** 2))


def draw_disturbance(
    truth: Truth,
    hardware: LoopHardware,
    *,
    frames: int,
    cases: int = 1,
    seed: int = 0,
    zero_frame: int = 0,
    frame_means: bool = False,
) -> Disturbance:
    """Draw the phase and the noise of all sensors of a loop, each from a random stream."""
    rng, noise_rng, other_rng = np.random.default_rng(seed).spawn(3)
    size = {"frames": frames, "cases": cases}
    others = bool(hardware.suite.sensors)
    phase, lines = draw_phase(
        truth,
        hardware,
        rng=rng,
        zero_frame=zero_frame,
        frame_means=frame_means,
        oscillators=others,
        **size,
    )
    q = hardware.n_measurements
    noise = truth.noise_per_measurement(q) * noise_rng.standard_normal((cases, frames, q))
    if others:
        readings = draw_others(truth, hardware, lines, other_rng, zero_frame=zero_frame, **size)
        noise = np.concatenate([noise, readings], axis=2)
    return Disturbance(
        phase_nm=phase, noise=noise, sensor_gain=truth.sensor_gain, frame_means=frame_means
    )


def draw_phase(
    truth: Truth,
    hardware: LoopHardware,
    *,
    frames: int,
    cases: int,
    rng: np.random.Generator,
    zero_frame: int = 0,
    frame_means: bool = False,
    oscillators: bool = False,
) -> tuple[FloatArray, list[DrawnLine]]:
    """Draw the mean phase over each frame, (cases, frames, n) [nm], and each vibration.

    Each part has its own random stream: a truth with one more vibration keeps its turbulence. Time
    0 of a vibration that drifts is frame ``zero_frame``. With ``oscillators``, resonances that
    channels of the truth see are continuous, others AR2 processes.
    """
    n = hardware.modes
    turbulence_rng, *line_rngs = rng.spawn(1 + len(truth.vibrations))
    total = np.zeros((cases, frames, n))
    lines: list[DrawnLine] = []
    spectra, size = truth.turbulence_per_mode(n), (frames, cases)
    means = {"frame_means": frame_means}
    if truth.is_uniform and spectra[0] is not None:
        drawn = _draw(spectra[0], hardware, frames, cases * n, turbulence_rng, **means)
        total += np.moveaxis(drawn.reshape(cases, n, frames), 1, 2)
    elif not truth.is_uniform:
        for mode, (own, mode_rng) in enumerate(zip(spectra, turbulence_rng.spawn(n), strict=True)):
            if own is not None:
                total[:, :, mode] += _draw(own, hardware, *size, mode_rng, **means)
    for vibration, seen, line_rng in zip(truth.vibrations, truth.motions, line_rngs, strict=True):
        direction = checked_direction(vibration, hardware)
        if isinstance(vibration, Vibration) and seen and oscillators:
            alone = seen_vibration(vibration, {}, (), hardware)
            drive = line_rng.standard_normal((cases, 1 + frames, alone.B.shape[-1]))
            lines.append((run_oscillator(alone, vibration, drive)[:, :, 0], drive))
        else:
            time_s = (np.arange(frames) - zero_frame) / hardware.frame_rate_hz
            motion, frequency_hz = _draw_line(vibration, hardware, time_s, cases, line_rng)
            share = 1.0 if frame_means else np.sinc(frequency_hz / hardware.frame_rate_hz)
            lines.append((share * motion, np.empty((cases, 1 + frames, 0))))
        total += lines[-1][0][:, :, None] * direction
    return total, lines


def _draw_line(
    vibration: Vibration | SinusoidalVibration,
    hardware: LoopHardware,
    time_s: FloatArray,
    cases: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return a line of its rms, (cases, frames), and its frequencies of the moment [Hz]."""
    rate, frames = hardware.frame_rate_hz, len(time_s)
    if isinstance(vibration, Vibration):
        constant_hz = np.full(frames, vibration.frequency_hz)
        return _draw_ar(vibration.ar_model(rate), frames, cases, rng), constant_hz
    turns = vibration.frequency_hz / rate * np.arange(frames)
    if vibration.drifts:
        turns = vibration.turns_at(time_s)
    phase = rng.uniform(0, 2 * np.pi, (cases, 1))
    series = vibration.amplitude_nm * np.cos(2 * np.pi * turns + phase)
    return series, vibration.frequency_hz_at(time_s)


def run_oscillator(seen: SeenVibration, line: Vibration, drive: FloatArray) -> FloatArray:
    """Return mean positions and readings of a line, (cases, frames, 1 + c), by its drive.

    Exposures that begin before the first frame see the oscillator at rest there.
    """
    A, B, C, _ = seen.stacks()
    state = line.rms_nm * seen.still @ drive[:, 0, :2].T
    out = np.empty((drive.shape[1] - 1, C.shape[1], len(drive)))
    for k, white in enumerate(drive[:, 1:].transpose(1, 2, 0)):
        before = (k - 1) % seen.period
        state = A[before] @ state + B[before] @ white
        out[k] = C[k % seen.period] @ state
    return np.asarray(out.transpose(2, 0, 1))


def draw_others(
    truth: Truth,
    hardware: LoopHardware,
    lines: Sequence[DrawnLine],
    rng: np.random.Generator,
    *,
    frames: int,
    cases: int,
    zero_frame: int,
) -> FloatArray:
    """Draw noise and accelerations in the readings of the other sensors, (cases, frames, q)."""
    suite = hardware.suite
    factors = [sensor.noise_factor(hardware.modes) for sensor in suite.sensors]
    drawn = [rng.standard_normal((cases, frames, len(factor))) @ factor.T for factor in factors]
    out = np.concatenate(drawn, axis=2)
    moving = checked_motions(truth.motions, suite, len(lines))
    first = out.shape[2] - len(suite.channels)  # column of the first channel
    for vibration, (motion, white), moved in zip(truth.vibrations, lines, moving, strict=True):
        seen = [first + i for i, name in enumerate(suite.channels) if name in moved]
        if not seen:
            continue
        if isinstance(vibration, Vibration):
            process = seen_vibration(vibration, moved, suite.accelerometers, hardware)
            inner = rng.standard_normal((cases, 1 + frames, process.B.shape[-1] - 3))
            drive = np.concatenate([white, inner], axis=2)
            out[:, :, seen] += run_oscillator(process, vibration, drive)[:, :, 1:]
        else:
            time_s = (np.arange(frames) - zero_frame) / hardware.frame_rate_hz
            readings = [
                _acceleration(sensor, hardware, vibration, motion, moved[name], time_s)
                for sensor in suite.accelerometers
                for name in sensor.channels
                if name in moved
            ]
            out[:, :, seen] += np.stack(readings, axis=2)
    return out


def _acceleration(
    sensor: Accelerometer,
    hardware: LoopHardware,
    line: SinusoidalVibration,
    motion: FloatArray,
    moved: Motion,
    time_s: FloatArray,
) -> FloatArray:
    """Return what a channel reads of a sinusoid, (cases, frames) [m/s^2]."""
    frequency_hz = line.frequency_hz_at(time_s)
    turn = 2 * np.pi * frequency_hz * hardware.dt_s
    # whole frames of the age are a delay; what is left of it turns the phase, by two frames
    newest = int(sensor.age_frames(hardware) - period_frames(sensor, hardware) + 1)
    swing = sensor.swing(moved, frequency_hz, hardware) * np.exp(1j * turn * newest)
    # beyond its begin the motion counts as still: the first readings are in the settling
    padded = np.pad(motion, ((0, 0), (newest + 1, 0)), mode="edge")[:, : motion.shape[1] + 1]
    now, before = padded[:, 1:], padded[:, :-1]
    return np.asarray(swing.real * now - swing.imag * (before - np.cos(turn) * now) / np.sin(turn))


def _draw(
    spectrum: Spectrum,
    hardware: LoopHardware,
    frames: int,
    cases: int,
    rng: np.random.Generator,
    *,
    frame_means: bool,
) -> FloatArray:
    if isinstance(spectrum, ARModel):
        return _draw_ar(spectrum, frames, cases, rng)
    rate = hardware.frame_rate_hz
    length = next_fast_len(_PERIODS * frames, real=True)
    length += length % 2  # an even length has a bin at the Nyquist frequency
    # E|X_k|^2 = power_k length^2 / 2; the two end bins are real, with twice that variance
    amplitude = length * np.sqrt(_bin_powers(spectrum, rate, length)) / 2
    if not frame_means:
        amplitude *= np.sinc(rfftfreq(length))
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
