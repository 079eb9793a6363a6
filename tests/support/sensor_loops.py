"""Loops of several sensors, run frame by frame from their equations, without the package's."""

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter
from support.oscillators import KickedOscillator

import lbt_synth as lbt
from lbt_synth.models.sensor_suite import Accelerometer, Motion, SensorSuite, WavefrontSensor

RATE_HZ = 1000.0
AIR = lbt.models.ARModel(coefficients=[0.95], driving_rms_nm=60, frame_rate_hz=RATE_HZ)
LINES = (
    lbt.Vibration(frequency_hz=60, damping=0.1, rms_nm=300, direction=(1, 0)),
    lbt.Vibration(frequency_hz=95, damping=0.08, rms_nm=100, direction=(1, 1)),
)
MOTIONS = ({"m1": Motion(size=2.0), "m2": Motion(size=0.5, phase_deg=150)}, {"m2": Motion(size=1)})
CHANNELS = {"channels": ("m1", "m2"), "noise_m_s2": [[4e-6, 1e-6], [1e-6, 9e-6]]}
FAST = Accelerometer(name="mirror", rate_hz=RATE_HZ, delay_frames=2, highpass_hz=3.0, **CHANNELS)
SLOW = WavefrontSensor(
    name="truth",
    rate_hz=RATE_HZ / 4,
    delay_frames=3,
    noise_nm=[[16, 6], [6, 9]],
    sensor_matrix=[[1.0, 0.2], [0.0, 0.9]],
)


def example_plant(sensors=(FAST, SLOW), *, lines=LINES, motions=MOTIONS, **changes):
    """Return a plant of two modes at 1 kHz; only the channels of its sensors move."""
    facts = {"turbulence": AIR, "noise_nm": 75.0, "delay_frames": 2} | changes
    own = lbt.tip_tilt_plant(frame_rate_hz=RATE_HZ, vibrations=lines, **facts)
    suite = SensorSuite(sensors=sensors)
    moved = [{name: each[name] for name in each if name in suite.channels} for each in motions]
    return own.with_sensors(suite, tuple(moved))


def frames_per_reading(hardware, sensor):
    """Return the frames of the loop between two readings."""
    return round(hardware.frame_rate_hz / sensor.rate_hz)


def age_frames(hardware, sensor):
    """Return how long before a frame its reading began, by the definition of the delays."""
    return sensor.delay_frames * frames_per_reading(hardware, sensor) - hardware.delay_frames + 1


def held_mean(history, k, age, frames):
    """Return the mean over ``frames`` frames from ``k - age`` on of a signal held in each frame."""
    start, out = k - age, np.zeros_like(history[0])
    for i in range(int(np.floor(start)), int(np.ceil(start + frames))):
        share = min(i + 1, start + frames) - max(i, start)
        if i >= 0 and share > 1e-9:
            out = out + share * history[i]
    return out / frames


def channel_factor(sensor, motion, frequency_hz):
    """Return the complex factor of a channel at the frequency of a line."""
    factor = motion.size * np.exp(1j * np.deg2rad(motion.phase_deg))
    return factor / (1 + (sensor.highpass_hz or 0.0) / (1j * frequency_hz))


def newest_end(hardware, sensor):
    """Return how many frames before the end of a frame its reading's exposure ends."""
    return age_frames(hardware, sensor) - frames_per_reading(hardware, sensor) + 1


def acceleration(hardware, sensor, motion, line):
    """Return mean positions and readings (frames, kicks) of a line after kicks in frame 0.

    A reading is the mean over its exposure: acceleration, and velocity where it is out of phase.
    """
    w, period = 2 * np.pi * line.frequency_hz, frames_per_reading(hardware, sensor)
    newest = newest_end(hardware, sensor)
    whole = int(np.floor(newest + 1e-9))
    oscillator = KickedOscillator(w * hardware.dt_s, line.damping, line.rms_nm, steps=8)
    positions, states = oscillator.paths(1 - (newest - whole), 400)
    ends = np.concatenate([np.zeros((whole + period, *states.shape[1:])), states])
    change = ends[period : period + len(states)] - ends[: len(states)]
    x, v = np.moveaxis(change / (period * hardware.dt_s), 2, 0)
    factor = channel_factor(sensor, motion, line.frequency_hz)
    return positions, 1e-9 * w * (factor.real * v - factor.imag * x)


def sinusoid_reading(hardware, sensor, motion, frequency_hz, signal):
    """Return what a channel reads (frames,) of a sinusoid of mean positions (frames,) [nm]."""
    w, frames = 2 * np.pi * frequency_hz, np.arange(len(signal))
    wave = np.exp(1j * w * hardware.dt_s * frames)
    parts = np.linalg.lstsq(np.stack([wave.real, -wave.imag], axis=1), signal)[0]
    ages = newest_end(hardware, sensor) + np.arange(frames_per_reading(hardware, sensor))
    mean = np.mean(np.exp(-1j * w * hardware.dt_s * ages))
    factor = channel_factor(sensor, motion, frequency_hz)
    return np.real(-1e-9 * w**2 * factor * mean * complex(*parts) * wave)


def run_loop(plant, controller, total, added, *, sensor_gain=1.0, blind=(), stuck=0.0):
    """Return the residual (frames, runs, n) of a loop that starts at rest.

    ``added`` is what readings (frames, runs, q) have beside the phase: noise, acceleration. What is
    not new is a large number; sensors that are blind read what is stuck (runs, q), or zero.
    """
    hardware, suite = plant.hardware, plant.hardware.suite
    taps, frames, runs = hardware.mirror_taps, *total.shape[:2]
    rows = suite.rows(hardware)
    sources = [("wavefront", hardware.sensor, 1.0, 1, sensor_gain)]
    for sensor in suite.wavefront:
        age, period = age_frames(hardware, sensor), frames_per_reading(hardware, sensor)
        response = np.eye(hardware.modes) if sensor.sensor_matrix is None else sensor.sensor_matrix
        sources.append((sensor.name, response, age, period, 1.0))
    periods = dict.fromkeys(rows, 1)
    for sensor in suite.sensors:
        periods |= dict.fromkeys(sensor.units, frames_per_reading(hardware, sensor))
    state = np.zeros((runs, controller.n_states))
    command = np.zeros((frames, runs, hardware.n_commands))
    residual = np.zeros_like(total)
    for k in range(frames):
        y = added[k].copy()
        for name, response, age, period, gain in sources:
            if k % period == 0:
                y[:, rows[name]] += gain * held_mean(residual, k, age, period) @ response.T
        for name, own in rows.items():
            if name in blind:
                y[:, own] = (stuck + 0 * y)[:, own]
            if k % periods[name]:
                y[:, own] = 1e9
        A, B, C, D = (stack[k % controller.period] for stack in controller.stacks())
        state = state @ A.T + y @ B.T
        command[k] = state @ C.T + y @ D.T
        correction = sum(taps[i] * command[k - i] for i in range(min(len(taps), k + 1)))
        residual[k] = total[k] - correction @ hardware.influence.T
    return residual


def simulated_covariances(plant, controller, *, frames=300, **loop):
    """Return the residual's covariances (n, n) by origin: turbulence, vibrations, noise.

    They are sums of the squares of what impulses leave, mean over the phases where they come.
    """
    hardware, suite, N = plant.hardware, plant.hardware.suite, plant.period
    n, rows = hardware.modes, suite.rows(hardware)
    q = max(own.stop for own in rows.values())
    begin, none = 4 * N if N > 1 else 8, np.zeros((frames, 1, q))
    sources = []  # origin, signals (frames, runs), their direction, and what readings have of them

    def drive(origin, model, direction):
        white = model.driving_rms_nm * np.eye(frames, 1)
        signal = lfilter([1.0], [1.0, *-np.asarray(model.coefficients)], white, axis=0)
        sources.append((origin, signal, direction, none))

    for mode, model in enumerate(plant.turbulence):
        drive(0, model, np.eye(n)[mode])
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        direction = np.array(line.direction)
        if not motion:
            drive(1, line.ar_model(RATE_HZ), direction)
            continue
        readings = {}
        for sensor in suite.accelerometers:
            for channel in motion.keys() & set(sensor.channels):
                signal, one = acceleration(hardware, sensor, motion[channel], line)
                readings[rows[channel].start] = one
        read = np.zeros((*signal.shape, q))
        for row, one in readings.items():
            read[:, :, row] = one
        sources.append((1, signal, direction, read))
    factors = [plant.own_noise_factor, *(each.noise_factor(n) for each in suite.sensors)]
    for column in block_diag(*factors).T:
        read = none.copy()
        read[0, 0] = column
        sources.append((2, none[:, :, 0], np.zeros(n), read))
    total, added, origins = [], [], []
    for origin, signal, direction, read in sources:
        for t in range(N):
            pad = ((begin + t, N - t), (0, 0))
            total.append(np.pad(signal[:frames], pad)[:, :, None] * direction)
            added.append(np.pad(read[:frames], (*pad, (0, 0))))
            origins += [origin] * signal.shape[1]
    total, added = (np.concatenate(series, axis=1) for series in (total, added))
    left = run_loop(plant, controller, total, added, **loop)
    powers = np.einsum("fri,frj->rij", left, left) / N
    return [powers[np.array(origins) == origin].sum(axis=0) for origin in range(3)]
