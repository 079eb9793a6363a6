"""Loops in continuous time, run in small steps from their equations, without the package's.

A frame has ``STEPS`` steps. The camera sees the phase less the mirror in the middle of each step.
"""

import numpy as np
from scipy.linalg import expm
from support.sensor_loops import age_frames, frames_per_reading, held_mean

STEPS = 400


class _Shell:
    """A mirror in its local loop, run sample by sample; commands are (runs, m)."""

    def __init__(self, loop, rate_hz, shape):
        self.loop, self.samples = loop, round(loop.sampling_hz / rate_hz)
        w, dt = 2 * np.pi * loop.natural_frequency_hz, 1 / loop.sampling_hz
        motion = np.zeros((3, 3))  # of position, velocity and a held acceleration
        motion[0, 1], motion[1] = 1.0, (-(w**2), -2 * loop.damping * w, 1.0)
        per_sample = STEPS // self.samples
        middles = (np.arange(per_sample) + 0.5) / per_sample
        self.between = np.stack([expm(motion * dt * part)[0] for part in middles])
        self.over = expm(motion * dt)
        self.stiffness = loop.feed_forward * w**2
        self.x, self.v, self.last = np.zeros((3, *shape), dtype=complex)
        self.waiting = [np.zeros(shape, dtype=complex)] * loop.delay_samples
        self.command = np.zeros(shape, dtype=complex)

    def hold(self, command):
        """Return the positions (STEPS, runs, m) while a command holds."""
        loop, out = self.loop, []
        for i in range(self.samples):
            share = min(1.0, (i + 1) / loop.ramp_samples)
            r = share * command + (1 - share) * self.command
            force = self.stiffness * r + loop.proportional_per_s2 * (r - self.x)
            force = force - loop.derivative_per_s * (self.x - self.last) * loop.sampling_hz
            self.waiting.append(force)
            state = np.stack([self.x, self.v, self.waiting.pop(0)])
            out.append(np.tensordot(self.between, state, axes=1))
            self.last = self.x
            self.x, self.v, _ = np.tensordot(self.over, state, axes=1)
        self.command = command
        return np.concatenate(out) / loop.static_gain


class _Settled:
    def __init__(self, loop, rate_hz, shape):
        pass

    def hold(self, command):
        """Return the positions (STEPS, runs, m) while a command holds."""
        return np.broadcast_to(command, (STEPS, *command.shape))


def image_residuals(hardware, controller, phase, noise, frames, *, sensor_gain=1.0):
    """Yield the residual (STEPS, runs, n) in each frame of a loop that starts at rest.

    ``phase(t)`` is the phase (STEPS, runs, n) at times t in frames, ``noise`` (runs, q) that of the
    first reading.
    """
    k, m = controller, hardware.n_commands
    runs = len(noise)
    kind = _Settled if hardware.mirror is None else _Shell
    mirror = kind(hardware.mirror, hardware.frame_rate_hz, (runs, m))
    late = round((hardware.delay_frames - 1) * STEPS)
    assert abs(late - (hardware.delay_frames - 1) * STEPS) < 1e-9
    ahead = np.zeros((late + STEPS, runs, m), dtype=complex)  # positions from this frame on
    state, seen = np.zeros((runs, k.n_states), dtype=complex), np.zeros((runs, hardware.modes))
    for frame in range(frames):
        y = sensor_gain * seen @ hardware.sensor.T + (noise if frame == 0 else 0)
        state = state @ k.A.T + y @ k.B.T
        ahead[late:] = mirror.hold(state @ k.C.T + y @ k.D.T)
        times = frame + (np.arange(STEPS) + 0.5) / STEPS
        residual = phase(times) - ahead[:STEPS] @ hardware.influence.T
        seen = residual.mean(axis=0)
        ahead = np.concatenate([ahead[STEPS:], np.zeros((STEPS, runs, m))])
        yield residual


def sinusoid_powers(hardware, controller, frequency_hz, along, *, frames=300, sensor_gain=1.0):
    """Return what sinusoids of unit power leave in the image, (f, n, n), one by one."""
    turns = 2j * np.pi * np.asarray(frequency_hz) / hardware.frame_rate_hz

    def phase(times):
        return np.exp(turns * times[:, None])[..., None] * np.asarray(along)

    noise = np.zeros((len(turns), hardware.n_measurements))
    for residual in image_residuals(
        hardware, controller, phase, noise, frames, sensor_gain=sensor_gain
    ):
        last = residual  # of a complex wave: its power repeats with the frame
    return np.real(np.einsum("tfi,tfj->fij", last, last.conj())) / STEPS


def noise_covariance(hardware, controller, noise_nm, *, frames=300, sensor_gain=1.0):
    """Return what white noise (q,) leaves in the image, (n, n): of impulses, one by one."""
    total, n = 0.0, hardware.modes
    for residual in image_residuals(
        hardware,
        controller,
        lambda t: np.zeros((STEPS, 1, n)),
        np.diag(noise_nm),
        frames,
        sensor_gain=sensor_gain,
    ):
        total = total + np.real(np.einsum("tfi,tfj->ij", residual, residual.conj())) / STEPS
    return total


def power_of_two_sensors(plant, controller, frequency_hz, along, *, frames=480):
    """Return what a sinusoid of unit power leaves in the image, (n, n), of a settled mirror.

    Beside its own sensor the loop reads one slower wavefront sensor. The mean is over 16 frames.
    """
    hardware, (slow,) = plant.hardware, plant.hardware.suite.wavefront
    n, rows, rate = hardware.modes, hardware.suite.rows(hardware), hardware.frame_rate_hz
    age, period = age_frames(hardware, slow), frames_per_reading(hardware, slow)
    late = round((hardware.delay_frames - 1) * STEPS)
    position = np.zeros(((frames + 8) * STEPS, n), dtype=complex)
    means, state = np.zeros((frames, n), dtype=complex), np.zeros(controller.n_states)
    power = np.zeros((n, n))
    for k in range(frames):
        y = np.zeros(hardware.n_readings, dtype=complex)
        y[rows["wavefront"]] = hardware.sensor @ held_mean(means, k, 1, 1)
        if k % period == 0:
            y[rows[slow.name]] = slow.sensor_matrix @ held_mean(means, k, age, period)
        now = controller.phase(k)
        state = now.A @ state + now.B @ y
        begin = k * STEPS + late
        position[begin : begin + STEPS] = hardware.influence @ (now.C @ state + now.D @ y)
        times = k + (np.arange(STEPS) + 0.5) / STEPS
        wave = np.exp(2j * np.pi * frequency_hz / rate * times)[:, None] * np.asarray(along)
        residual = wave - position[k * STEPS : (k + 1) * STEPS]
        means[k] = residual.mean(axis=0)
        if k >= frames - 16:
            power += np.real(residual.T @ residual.conj()) / STEPS / 16
    return power
