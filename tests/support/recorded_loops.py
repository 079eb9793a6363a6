"""Recorded loops of an integrator, for the tests of identification."""

from functools import cache

import numpy as np
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identify import axis_periodogram, find_axis, refit_axis
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.models.resonance_spectrum import coefficient_rows, drive_ratio

RATE = 1000.0
FRAMES = 16_384
LINE = ((31.0, 0.004, 60.0),)  # frequency [Hz], damping ratio, rms [nm]


def integrator_loop(
    *, lines=(), noise=6.0, sensor_gain=0.6, gain=0.4, frames=FRAMES, seed=0, axes=1, **air
):
    """Measurements and corrections of an integrator's loop, (frames, axes) each."""
    vibrations = [
        lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=np.eye(axes)[0])
        for f, z, r in lines
    ]
    facts = {"vibrations": vibrations, "noise_nm": noise, "sensor_gain": sensor_gain}
    truth = lbt.Truth(**{"turbulence": slow(), **facts, **air})
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=axes)
    run = _integrated(path, truth, gain=gain, frames=frames, seed=seed, frame_means=True)
    return run.measurements[0][2:], run.commands[0][:-2]


def _integrated(path, truth, *, gain, **options):
    return lbt.simulate(lbt.integrator(path, gain=gain).controller, truth, hardware=path, **options)


def record_of(run, path):
    """Return the record of a simulation."""
    facts = {"frame_rate_hz": path.frame_rate_hz, "delay_frames": path.delay_frames}
    return lbt.identification.loop_record(run.measurements[0], run.commands[0], unit="nm", **facts)


def slow():
    """Turbulence of 300 nm around 1 Hz."""
    place = 2 * np.pi * 1.0 / RATE, 0.6
    (a1, a2), drive = coefficient_rows(*map(np.array, place)), drive_ratio(*place)
    return lbt.models.ARModel(
        coefficients=[a1, a2], driving_rms_nm=300 * np.sqrt(drive), frame_rate_hz=RATE
    )


def identify_series(
    measurement, correction=None, *, stretches=None, start=None, sensor_gain_error=0.0, **options
):
    """Identify the series of one axis, at a sensor gain with an error if it is given."""
    rate_hz, sensor_gain = options.pop("frame_rate_hz", RATE), options.pop("sensor_gain", None)
    pieces = stretches or ((0, len(measurement)),)
    data = axis_periodogram(measurement, correction, rate_hz, pieces)
    search = Search(data=data, gain=sensor_gain, **options)
    axis = find_axis(search, start=start)
    if not sensor_gain_error:
        return axis
    return refit_axis(axis, search, sensor_gain_error / sensor_gain, "given")


def resonant_record(seed=0):
    """Return a loop of sensor gain 0.9 under frozen flow, two wide resonances and a line."""
    resonances = ((60.0, 0.1, 60.0, 20.0), (110.0, 0.08, 30.0, 120.0), (31.0, 0.004, 40.0, 70.0))
    truth = {"turbulence": _air(1.057, 39.57, 12.0), "noise_nm": 5.0, "sensor_gain": 0.9}
    return _directed_record(500.0, 0.4, resonances, seed, **truth)


def hidden_resonance_record(seed=63):
    """Return a loop of sensor gain 0.995 under a wide resonance that a lower gain explains."""
    resonances = (
        (35.41, 0.0075, 68.9, 83.8),
        (45.69, 0.0056, 29.1, 101.1),
        (124.98, 0.0031, 47.1, 79.1),
        (41.97, 0.0086, 84.6, 11.5),
        (20.17, 0.1502, 12.2, 173.3),
        (139.78, 0.1958, 84.1, 169.4),
    )
    truth = {"turbulence": _air(1.381, 23.6, 23.1), "noise_nm": 2.82, "sensor_gain": 0.995}
    return _directed_record(1000.0, 0.2266, resonances, seed, **truth)


@cache
def slanted_record():
    """Return the loop of two axes that share a line at 30 degrees."""
    line = (20.0, 0.005, 100.0, 30.0)
    return _directed_record(RATE, 0.3, (line,), 1, turbulence=slow(), noise_nm=6.0)


def drifting_record(seed=337, *, gain=0.4062):
    """Return a loop of gain 0.586 under a drift and frozen flow, which looks simpler at no gain."""
    path = lbt.LoopHardware(frame_rate_hz=723.0, modes=1)
    drift = lbt.models.ARModel(
        coefficients=[0.99988708], driving_rms_nm=3.8718, frame_rate_hz=path.frame_rate_hz
    )
    line = lbt.Vibration(frequency_hz=78.643, damping=0.00516, rms_nm=16.754, direction=(1.0,))
    total = lbt.models.SumSpectrum(parts=[_air(1.3785, 15.56, 12.702), drift])
    truth = lbt.Truth(turbulence=total, vibrations=(line,), noise_nm=3.403, sensor_gain=0.5859)
    options = {"frames": int(15 * path.frame_rate_hz), "seed": seed, "settle_frames": 2000}
    return record_of(_integrated(path, truth, gain=gain, **options), path)


def _air(seeing_arcsec, outer_scale_m, wind_speed_m_s):
    """Return the turbulence above a telescope of 8 m."""
    facts = {"seeing_arcsec": seeing_arcsec, "outer_scale_m": outer_scale_m}
    return lbt.Atmosphere(wind_speed_m_s=wind_speed_m_s, diameter_m=8.22, **facts)


def _directed_record(rate_hz, gain, resonances, seed, **truth):
    """Return half a minute of an integrator; resonances by frequency, damping, rms, direction."""
    path = lbt.LoopHardware(frame_rate_hz=rate_hz)
    lines = [
        lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=(np.cos(a), np.sin(a)))
        for f, z, r, a in ((*line[:3], np.deg2rad(line[3])) for line in resonances)
    ]
    options = {"frames": int(30 * rate_hz), "seed": seed, "settle_frames": 500, "frame_means": True}
    run = _integrated(path, lbt.Truth(vibrations=lines, **truth), gain=gain, **options)
    return record_of(run, path)


def expected_periodogram(air, noise, gain, seconds=30):
    """Return what the periodograms of some seconds of an integrator's loop scatter about."""
    f = np.arange(1, 500 * seconds) / seconds
    parts = air.parts if isinstance(air, lbt.models.SumSpectrum) else (air,)
    seen = sum(p.psd(f) * np.sinc(f / RATE) ** (2 * isinstance(p, lbt.Atmosphere)) for p in parts)
    delay = np.exp(-2j * np.pi * f / RATE)
    loop = 0.4 * delay**2 / (1 - delay)  # from measurements to the corrections in them
    measured = (gain**2 * seen + 2 / RATE * noise**2) / np.abs(1 + gain * loop) ** 2
    corrections = {"crossed": loop.real * measured, "corrected": np.abs(loop) ** 2 * measured}
    series = {"measured": measured, "count": np.ones(f.size), **corrections}
    return LoopPeriodogram(frequency_hz=f, frame_rate_hz=RATE, **series)


def spliced_record(seeds=(0,), *, delay=2.0, **options):
    """Records of one axis, end to end."""
    loops = [integrator_loop(seed=seed, **options) for seed in seeds]
    y = np.vstack([measurements[:-2] for measurements, _ in loops])
    u = np.vstack([corrections[2:] for _, corrections in loops])  # c(k) = u(k-2)
    return lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=delay, unit="nm")


def open_record(lines=(), *, shared_nm=0.0, noise=6.0, frames=FRAMES, seed=0):
    """Two axes in open loop with air in common; lines have the frames by which tilt follows tip."""
    rng = np.random.default_rng(seed)
    air, settle = slow(), 4000

    def process(model):
        drive = model.driving_rms_nm * rng.standard_normal(frames + settle)
        return lfilter([1.0], np.append(1.0, -model.coefficients), drive)[settle // 2 :]

    y = np.stack([process(air) for _ in range(2)]) + shared_nm / air.rms_nm * process(air)
    for line, late in lines:
        x = process(line.ar_model(RATE))
        y += np.outer(line.direction, x)
        y[1] += line.direction[1] * (np.roll(x, late) - x)
    y = y[:, -frames:].T + noise * rng.standard_normal((frames, 2))
    return lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
