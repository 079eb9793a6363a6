"""Telescope structures whose many modes are seen by accelerometers that mix them."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

import lbt_synth as lbt

OVERSAMPLED = 8  # steps of the structure in a frame
SLOW_HZ = (0.3, 3.0)  # corners of the air


@dataclass(frozen=True)
class Structure:
    """A loop beside a structure: what it measured, commanded and felt, and the truth."""

    frame_rate_hz: float
    noise_nm: float
    measurements: np.ndarray  # (frames, 2): y(k) = phi(k-1) - u(k-3) + noise [nm]
    commands: np.ndarray  # (frames, 2)
    readings: np.ndarray  # (frames, channels): mean accelerations over frame k-1 [m/s^2]
    phase: np.ndarray  # (frames, 2): phi(k-1), in the rows of the measurements [nm]

    @property
    def pseudo_open_loop(self):
        """What there would be without any correction, (frames, 2) [nm]."""
        series = self.measurements.copy()
        series[2:] += self.commands[:-2]
        return series

    def record(self, start, stop):
        series = self.measurements[start:stop], self.commands[start:stop]
        facts = {"frame_rate_hz": self.frame_rate_hz, "delay_frames": 2, "unit": "nm"}
        return lbt.identification.loop_record(*series, **facts)


def structure(seed, *, seconds=40.0, modes=(6, 20), channels=(3, 12), gain=0.4):
    """Draw a structure of modes of 5 to 250 Hz and damping 0.003 to 0.1, under a few forces.

    Each moves both axes and all channels by random factors; an integrator of two frames ran.
    """
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([500.0, 800.0, 1000.0]))
    frames, count = int(seconds * rate), int(rng.integers(modes[0], modes[1] + 1))
    sensors = int(rng.integers(channels[0], channels[1] + 1))
    frequencies = np.minimum(np.exp(rng.uniform(np.log(5), np.log(250), count)), 0.45 * rate)
    dampings = np.exp(rng.uniform(np.log(0.003), np.log(0.1), count))
    sizes = 200 * np.exp(0.8 * rng.standard_normal(count)) * 20 / frequencies
    steps = frames * OVERSAMPLED
    forces = lfilter([1], [1, -0.5], rng.standard_normal((steps, max(2, count // 3))), axis=0)
    motion, acceleration = np.zeros((frames, 2)), np.zeros((frames, sensors))
    for frequency, damping, rms in zip(frequencies, dampings, sizes, strict=True):
        force = forces @ rng.standard_normal(forces.shape[1])
        x, a = _oscillator(2 * np.pi * frequency, damping, force, 1 / (rate * OVERSAMPLED))
        scale = rms / np.std(x)
        x, a = (scale * s.reshape(frames, OVERSAMPLED).mean(axis=1) for s in (x, a))
        motion += np.outer(x, rng.standard_normal(2))
        acceleration += 1e-9 * np.outer(a, rng.standard_normal(sensors))
    poles = np.exp(-2 * np.pi * np.array(SLOW_HZ) / rate)
    air = lfilter([1], [1, -poles.sum(), poles.prod()], rng.standard_normal((frames, 2)), axis=0)
    phase = motion + air * rng.uniform(200, 1000) / air.std(axis=0)
    noise = float(rng.uniform(5, 40))
    acceleration += 1e-3 * rng.uniform(0.3, 3) * rng.standard_normal(acceleration.shape)
    y, u = np.zeros((2, frames, 2))
    drawn = noise * rng.standard_normal((frames, 2))
    for k in range(1, frames):
        y[k] = phase[k - 1] - u[k - 2] * (k > 1) + drawn[k]
        u[k] = u[k - 1] + gain * y[k]
    before = [np.vstack([series[:1], series[:-1]]) for series in (acceleration, phase)]
    return Structure(rate, noise, y, u, *before)


def _oscillator(w, damping, force, dt):
    """Return position and acceleration of an oscillator under a force that holds over steps."""
    A, B = np.array([[0, 1], [-w * w, -2 * damping * w]]), np.array([[0], [1.0]])
    F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), dt)
    poles = [1, -np.trace(F), np.linalg.det(F)]
    x, v = (
        lfilter([0, G[i, 0], F[i, 1 - i] * G[1 - i, 0] - F[1 - i, 1 - i] * G[i, 0]], poles, force)
        for i in range(2)
    )
    return x, force - w * w * x - 2 * damping * w * v
