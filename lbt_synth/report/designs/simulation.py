"""Spectra of the residual of a loop: simulated ones, and the exact one."""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from lbt_synth.loop import ClosedLoop, Simulation
from lbt_synth.models import ARModel, Truth, Vibration
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import FloatArray

_SEGMENT = 2048  # frames of a segment of the spectra, at most


def run_spectra(
    run: Simulation, loop: ClosedLoop, truth: Truth
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return frequencies [Hz], and spectra before the correction and after it, and the exact one.

    They are by Welch's method, means over the runs and sums over the axes [nm^2/Hz], (f,). The
    exact one is by the transfer functions, with the window's image of each sinusoid.
    """
    length = min(run.residual_nm.shape[1], _SEGMENT)
    spectra = []
    for series in (run.total_nm, run.residual_nm):
        f, density = welch(series, run.frame_rate_hz, nperseg=length, detrend=False, axis=1)
        spectra.append(density.mean(axis=0).sum(axis=-1)[1:])
    return f[1:], *spectra, exact_spectrum(loop, truth, f, length)[1:]


def exact_spectrum(
    loop: ClosedLoop, truth: Truth, frequency_hz: FloatArray, length: int
) -> FloatArray:
    """One-sided spectrum of the residual, summed over the axes [nm^2/Hz], (f,).

    It is that of means over frames; a spectrum S of the phase counts as ``S sinc^2(f / f_s)``.
    Random disturbances add ``|transfer|^2`` times that. A sinusoid of amplitude a at f0 adds what
    Welch's method makes of it with a Hann window w of that length:
    ``a^2 / 2 |W(f - f0)|^2 / (f_s sum w^2)``, W the window's Fourier transform.
    """
    n, rate = loop.hardware.modes, loop.hardware.frame_rate_hz
    inside = np.clip(frequency_hz, frequency_hz[1] / 2, None)  # spectra may be infinite at 0
    response = loop.system.frequency_response(inside)[:, :n]
    rejection, noise_transfer = response[:, :, :n], response[:, :, n:]
    total = np.zeros(frequency_hz.size)
    for spectrum, modes in truth.turbulence_groups(n):
        gain = np.sum(np.abs(rejection[:, :, list(modes)]) ** 2, axis=(1, 2))
        share = 1.0 if isinstance(spectrum, ARModel) else np.sinc(inside / rate) ** 2
        total += share * gain * spectrum.psd(inside)
    noise = noise_transfer * truth.noise_per_measurement(loop.hardware.n_measurements)
    total += np.sum(np.abs(noise) ** 2, axis=(1, 2)) * 2 / rate
    for line in stationary_vibrations(truth.vibrations):
        direction = checked_direction(line, loop.hardware)
        if isinstance(line, Vibration):
            gain = np.sum(np.abs(rejection @ direction) ** 2, axis=1)
            share = np.sinc(line.frequency_hz / rate) ** 2
            total += share * gain * line.ar_model(rate).psd(inside)
            continue
        seen_nm = np.sinc(line.frequency_hz / rate) * line.amplitude_nm
        left = seen_nm * loop.sensitivity([line.frequency_hz])[0] @ direction
        power = float(np.sum(np.abs(left) ** 2)) / 2
        offset = 2 * np.pi * (frequency_hz - line.frequency_hz) / rate
        # the sum of the squares of a Hann window is 3/8 of its length
        total += power * _hann_transform(offset, length) ** 2 / (rate * 0.375 * length)
    return total


def _hann_transform(angle: FloatArray, length: int) -> FloatArray:
    """Modulus of the Fourier transform of a periodic Hann window at angles [rad], (f,)."""
    step = 2 * np.pi / length
    shifted = angle + step * np.array([[-1.0], [0.0], [1.0]])
    half = np.sin(shifted / 2)
    safe = np.where(half == 0, 1.0, half)
    # kernels of Dirichlet with the phase of their middle, of which neighbours differ in sign
    kernels = np.where(half == 0, length, np.sin(length * shifted / 2) / safe)
    phases = np.exp(-0.5j * (length - 1) * shifted)
    return np.asarray(np.abs(np.array([-0.25, 0.5, -0.25]) @ (kernels * phases)))
