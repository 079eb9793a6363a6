"""Recorded loops of an integrator, for the tests of identification."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.identify import axis_periodogram, find_axis, refit_axis
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.models.resonance_spectrum import coefficient_rows, drive_ratio

RATE = 1000.0
FRAMES = 16_384
LINE = ((31.0, 0.004, 60.0),)  # frequency [Hz], damping ratio, rms [nm]


def integrator_loop(
    *,
    lines: tuple[tuple[float, float, float], ...] = (),
    noise: float = 6.0,
    sensor_gain: float = 0.6,
    gain: float = 0.4,
    frames: int = FRAMES,
    seed: int = 0,
    turbulence: lbt.models.ARModel | None = None,
    axes: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and corrections of an integrator's loop, (frames, axes) each."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=axes)
    direction = (1.0,) if axes == 1 else (1.0, 0.0)
    truth = lbt.Truth(
        turbulence=slow() if turbulence is None else turbulence,
        vibrations=tuple(
            lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=direction)
            for f, z, r in lines
        ),
        noise_nm=noise,
        sensor_gain=sensor_gain,
    )
    controller = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(controller, truth, hardware=path, frames=frames, seed=seed, frame_means=True)
    return run.measurements[0][2:], run.commands[0][:-2]


def slow() -> lbt.models.ARModel:
    """Turbulence of 300 nm around 1 Hz."""
    place = 2 * np.pi * 1.0 / RATE, 0.6
    (a1, a2), drive = coefficient_rows(*map(np.array, place)), drive_ratio(*place)
    return lbt.models.ARModel(
        coefficients=[a1, a2], driving_rms_nm=300 * np.sqrt(drive), frame_rate_hz=RATE
    )


def identify_series(
    measurement: np.ndarray,
    correction: np.ndarray | None = None,
    *,
    frame_rate_hz: float = RATE,
    stretches: object = None,
    sensor_gain: float | None = None,
    sensor_gain_error: float = 0.0,
    start: IdentifiedAxis | None = None,
    **options: object,
) -> IdentifiedAxis:
    """Identify the series of one axis, at a sensor gain with an error if it is given."""
    pieces = stretches or ((0, len(measurement)),)
    data = axis_periodogram(measurement, correction, frame_rate_hz, pieces)
    search = Search(data=data, gain=sensor_gain, **options)
    axis = find_axis(search, start=start)
    if not sensor_gain_error:
        return axis
    return refit_axis(axis, search, sensor_gain_error / sensor_gain, "given")


def resonant_record(seed: int = 0) -> lbt.identification.LoopRecord:
    """Return a loop of sensor gain 0.9 under frozen flow, two wide resonances and a line."""
    resonances = ((60.0, 0.1, 60.0, 20.0), (110.0, 0.08, 30.0, 120.0), (31.0, 0.004, 40.0, 70.0))
    return _directed_record(500.0, 0.9, 0.4, 5.0, resonances, _air(12.0), seed)


def hidden_resonance_record(seed: int = 63) -> lbt.identification.LoopRecord:
    """Return a loop of sensor gain 0.995 under a wide resonance that a lower gain explains."""
    resonances = (
        (35.41, 0.0075, 68.9, 83.8),
        (45.69, 0.0056, 29.1, 101.1),
        (124.98, 0.0031, 47.1, 79.1),
        (41.97, 0.0086, 84.6, 11.5),
        (20.17, 0.1502, 12.2, 173.3),
        (139.78, 0.1958, 84.1, 169.4),
    )
    air = lbt.Atmosphere(
        seeing_arcsec=1.381, outer_scale_m=23.6, wind_speed_m_s=23.1, diameter_m=8.22
    )
    return _directed_record(1000.0, 0.995, 0.2266, 2.82, resonances, air, seed)


def drifting_record(seed: int = 337, *, gain: float = 0.4062) -> lbt.identification.LoopRecord:
    """Return a loop of sensor gain 0.586 under a drift and frozen flow, of which no model has both.

    The spectrum in closed loop is simpler: coloured noise over a line, at no gain at all.
    """
    rate_hz = 723.0
    path = lbt.LoopHardware(frame_rate_hz=rate_hz, modes=1)
    air = lbt.Atmosphere(
        seeing_arcsec=1.3785, outer_scale_m=15.56, wind_speed_m_s=12.702, diameter_m=8.22
    )
    drift = lbt.models.ARModel(
        coefficients=[0.99988708], driving_rms_nm=3.8718, frame_rate_hz=rate_hz
    )
    line = lbt.Vibration(frequency_hz=78.643, damping=0.00516, rms_nm=16.754, direction=(1.0,))
    total = lbt.models.SumSpectrum(parts=[air, drift])
    truth = lbt.Truth(turbulence=total, vibrations=(line,), noise_nm=3.403, sensor_gain=0.5859)
    law, frames = lbt.integrator(path, gain=gain).controller, int(15 * rate_hz)
    run = lbt.simulate(law, truth, hardware=path, frames=frames, seed=seed, settle_frames=2000)
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=rate_hz, delay_frames=2, unit="nm"
    )


def _air(wind_speed_m_s: float) -> lbt.Atmosphere:
    """Return strong turbulence above a telescope of 8 m."""
    return lbt.Atmosphere(
        seeing_arcsec=1.057, outer_scale_m=39.57, wind_speed_m_s=wind_speed_m_s, diameter_m=8.22
    )


def _directed_record(
    rate_hz: float,
    sensor_gain: float,
    gain: float,
    noise_nm: float,
    resonances: tuple[tuple[float, float, float, float], ...],
    air: lbt.Atmosphere,
    seed: int,
) -> lbt.identification.LoopRecord:
    """Return half a minute of an integrator; resonances by frequency, damping, rms, direction."""
    path = lbt.LoopHardware(frame_rate_hz=rate_hz)
    truth = lbt.Truth(
        turbulence=air,
        vibrations=tuple(
            lbt.Vibration(
                frequency_hz=f,
                damping=z,
                rms_nm=r,
                direction=(np.cos(np.deg2rad(a)), np.sin(np.deg2rad(a))),
            )
            for f, z, r, a in resonances
        ),
        noise_nm=noise_nm,
        sensor_gain=sensor_gain,
    )
    law, frames = lbt.integrator(path, gain=gain).controller, int(30 * rate_hz)
    run = lbt.simulate(
        law, truth, hardware=path, frames=frames, seed=seed, settle_frames=500, frame_means=True
    )
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=rate_hz, delay_frames=2, unit="nm"
    )


def expected_periodogram(air: lbt.models.Spectrum, noise: float, gain: float) -> LoopPeriodogram:
    """Return what the periodograms of half a minute of an integrator's loop scatter about."""
    f = np.arange(1, 15_000) / 30
    parts = air.parts if isinstance(air, lbt.models.SumSpectrum) else (air,)
    seen = sum(p.psd(f) * np.sinc(f / RATE) ** (2 * isinstance(p, lbt.Atmosphere)) for p in parts)
    delay = np.exp(-2j * np.pi * f / RATE)
    loop = 0.4 * delay**2 / (1 - delay)  # from measurements to the corrections in them
    measured = gain**2 * seen + 2 / RATE * noise**2
    measured = measured / np.abs(1 + gain * loop) ** 2
    return LoopPeriodogram(
        frequency_hz=f,
        measured=measured,
        crossed=loop.real * measured,
        corrected=np.abs(loop) ** 2 * measured,
        count=np.ones(f.size),
        frame_rate_hz=RATE,
    )


def spliced_record(
    seeds: tuple[int, ...] = (0,), *, delay: float = 2.0, **options
) -> lbt.identification.LoopRecord:
    """Records of one axis, end to end."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    series = []
    for seed in seeds:
        y, c = integrator_loop(seed=seed, **options)
        u = np.vstack([c[2:], c[-2:]])  # c(k) = u(k-2)
        series.append((y[:-2], u[:-2]))
    y, u = (np.vstack([one[i] for one in series]) for i in range(2))
    assert path.delay_frames == 2
    return lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=delay, unit="nm")


def open_record(
    lines: tuple[tuple[lbt.Vibration, int], ...] = (),
    *,
    shared_nm: float = 0.0,
    noise: float = 6.0,
    frames: int = FRAMES,
    seed: int = 0,
) -> lbt.identification.LoopRecord:
    """An open loop of two axes whose turbulence has a part in common.

    Lines come with the frames by which tilt follows tip.
    """
    rng = np.random.default_rng(seed)
    air, settle = slow(), 4000

    def process(model: lbt.models.ARModel) -> np.ndarray:
        drive = model.driving_rms_nm * rng.standard_normal(frames + settle)
        return lfilter([1.0], np.append(1.0, -model.coefficients), drive)[settle // 2 :]

    y = np.stack([process(air) for _ in range(2)]) + shared_nm / air.rms_nm * process(air)
    for line, late in lines:
        x = process(line.ar_model(RATE))
        y += np.outer(line.direction, x)
        y[1] += line.direction[1] * (np.roll(x, late) - x)
    y = y[:, -frames:].T + noise * rng.standard_normal((frames, 2))
    return lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
