"""Loops of several sensors, run frame by frame from their equations, without the package's."""

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.models.plant.readings import fused_plant
from lbt_synth.models.sensor_suite import Accelerometer, Motion, SensorSuite, WavefrontSensor

RATE_HZ = 1000.0
AIR = lbt.models.ARModel(coefficients=[0.95], driving_rms_nm=60, frame_rate_hz=RATE_HZ)
LINES = (
    lbt.Vibration(frequency_hz=60, damping=0.1, rms_nm=300, direction=(1, 0)),
    lbt.Vibration(frequency_hz=95, damping=0.08, rms_nm=100, direction=(1, 1)),
)
MOTIONS = ({"m1": Motion(size=2.0), "m2": Motion(size=0.5, phase_deg=150)}, {"m2": Motion(size=1)})
FAST = Accelerometer(
    name="mirror",
    rate_hz=RATE_HZ,
    delay_frames=2,
    channels=("m1", "m2"),
    noise_m_s2=[[4e-6, 1e-6], [1e-6, 9e-6]],
    highpass_hz=3.0,
)
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
    own = lbt.tip_tilt_plant(frame_rate_hz=RATE_HZ, vibrations=lines or None, **facts)
    suite = SensorSuite(sensors=sensors)
    moved = [{name: each[name] for name in each if name in suite.channels} for each in motions]
    return fused_plant(own, suite, tuple(moved))


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


def acceleration(hardware, sensor, motion, frequency_hz, signal):
    """Return what a channel reads in each frame of a vibration (frames, ...), in m/s^2."""
    age, step = age_frames(hardware, sensor), 2 * np.pi * frequency_hz / hardware.frame_rate_hz
    whole = int(np.floor(age + 1e-9))
    factor = motion.size * np.exp(1j * (np.deg2rad(motion.phase_deg) - step * (age - whole)))
    if sensor.highpass_hz:
        factor = factor / (1 + sensor.highpass_hz / (1j * frequency_hz))
    # two successive samples have this factor at the frequency of the vibration
    turn = np.exp(-1j * step)
    first, second = np.linalg.solve([[1, turn.real], [0, turn.imag]], [factor.real, factor.imag])
    v = np.concatenate([np.zeros((whole + 3, *signal.shape[1:])), signal, 0 * signal[:1]])
    bend = (v[2:] - 2 * v[1:-1] + v[:-2]) * hardware.frame_rate_hz**2 * 1e-9
    k = np.arange(len(signal)) + whole + 2  # bend[i] is that at sample i + 1 of v
    return first * bend[k - whole] + second * bend[k - whole - 1]


def run_loop(plant, controller, total, added, *, sensor_gain=1.0, blind=(), stuck=0.0):
    """Return the residual (frames, runs, n) of a loop that starts at rest.

    ``total`` is the phase (frames, runs, n), ``added`` what each reading has beside it: noise, and
    the acceleration of channels (frames, runs, q). A reading that is not new is a large number.
    Sensors that are blind read what is stuck (runs, q), or zero.
    """
    hardware, suite = plant.own.hardware, plant.suite
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
        now = controller.phase(k)
        state = state @ now.A.T + y @ now.B.T
        command[k] = state @ now.C.T + y @ now.D.T
        correction = sum(taps[i] * command[k - i] for i in range(min(len(taps), k + 1)))
        residual[k] = total[k] - correction @ hardware.influence.T
    return residual


def impulse(frames, runs, size, entries):
    """Return a signal (frames, runs, size) of unit impulses: (run, frame, column) each."""
    out = np.zeros((frames, runs, size))
    for run, frame, column in entries:
        out[frame, run, column] = 1.0
    return out


def simulated_covariances(plant, controller, *, frames=300, **loop):
    """Return the residual's covariances (n, n) by origin: turbulence, vibrations, noise.

    White noise leaves the sum of the squares of what an impulse leaves, mean over the phases in
    which it may come. All impulses run side by side.
    """
    hardware, suite, N = plant.own.hardware, plant.suite, plant.period
    n, rows = hardware.modes, suite.rows(hardware)
    q = max(own.stop for own in rows.values())
    begin = 4 * N if N > 1 else 8
    total, added, origins = [], [], []

    def drive(origin, model, direction, motion, frequency_hz):
        for t in range(N):
            white = np.zeros(begin + N + frames)
            white[begin + t] = model.driving_rms_nm
            signal = lfilter([1.0], [1.0, *-np.asarray(model.coefficients)], white)
            read = np.zeros((len(white), q))
            for sensor in suite.accelerometers:
                for channel in motion.keys() & set(sensor.channels):
                    own = acceleration(hardware, sensor, motion[channel], frequency_hz, signal)
                    read[:, rows[channel].start] = own
            total.append(signal[:, None] * direction)
            added.append(read)
            origins.append(origin)

    for mode, model in enumerate(plant.own.turbulence):
        drive(0, model, np.eye(n)[mode], {}, 0.0)
    for line, motion in zip(plant.own.vibrations, plant.motions, strict=True):
        model, direction = line.ar_model(RATE_HZ), np.array(line.direction)
        drive(1, model, direction, motion, line.frequency_hz)
    factors = [plant.own.D[:, -hardware.n_measurements :]]
    factors += [each.noise_factor(n) for each in suite.sensors]
    for column in block_diag(*factors).T:
        for t in range(N):
            read = np.zeros((begin + N + frames, q))
            read[begin + t] = column
            total.append(np.zeros((len(read), n)))
            added.append(read)
            origins.append(2)
    left = run_loop(plant, controller, np.stack(total, axis=1), np.stack(added, axis=1), **loop)
    powers = np.einsum("fri,frj->rij", left, left) / N
    return [powers[np.array(origins) == origin].sum(axis=0) for origin in range(3)]
