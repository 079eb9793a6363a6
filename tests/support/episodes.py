"""Loops whose commands are clipped, not applied or held for a while, many at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear import estimator_form
from lbt_synth.loop.simulation import settling_frames
from lbt_synth.loop.stable_range import affine_radii, parts_by_gain

QUIET, LONGEST = 200, 400  # frames before an episode, and of one at most
KINDS = ("clipped", "open", "held")
TURBULENCE_NM, POLE, LINE_NM, LINE_HZ, NOISE_NM = 592.0, 0.9886, 797.0, 20.0, 15.5
BACK = 0.01  # of the rms residual


@dataclass
class Episodes:
    """What happens to each of many loops, and how long each may take to come back."""

    gains: np.ndarray  # of the sensor
    kinds: np.ndarray
    ends: np.ndarray  # first frame after the episode
    depth: np.ndarray  # of clipping, as a part of the largest command
    settling: np.ndarray  # frames to 1e-4

    @classmethod
    def draw(cls, design, count, rng, gains):
        found = np.sort(rng.uniform(*gains, count))
        radii = affine_radii(parts_by_gain(design.hardware, design.controller), found)
        return cls(
            gains=found,
            kinds=rng.integers(len(KINDS), size=count),
            ends=QUIET + rng.integers(1, LONGEST, size=count),
            depth=rng.uniform(0, 0.7, size=count),
            settling=np.array([settling_frames(radius) for radius in radii]),
        )


def disturbances(count, frames, rng, rate):
    """Frames of turbulence, a vibration of the first axis and noise, (count, 2) each."""
    air = TURBULENCE_NM * rng.standard_normal((count, 2))
    phase = rng.uniform(0, 2 * np.pi, count)
    for k in range(frames):
        line = LINE_NM * np.sqrt(2) * np.sin(2 * np.pi * LINE_HZ / rate * k + phase)
        yield air + np.stack([line, 0 * line], axis=1), NOISE_NM * rng.standard_normal((count, 2))
        kick = TURBULENCE_NM * np.sqrt(1 - POLE**2) * rng.standard_normal((count, 2))
        air = POLE * air + kick


class Run:
    """Many loops of two frames' delay around one controller, in either form."""

    def __init__(self, design, count, *, given):
        k = design.controller
        form = estimator_form(design)
        assert design.hardware.delay_frames == 2
        assert not k.D.any()
        rows = [form.A, form.B, form.applied] if given else [k.A, k.B, 0 * form.applied]
        self.step_matrix, self.C = np.hstack(rows).T, k.C.T
        self.state = np.zeros((count, k.n_states))
        self.applied, self.residual = np.zeros((2, count, 2))

    def frame(self, total, noise, gains, change):
        """Step all loops; ``change`` makes the applied commands of those that are computed."""
        y = gains[:, None] * self.residual + noise
        self.state = np.hstack([self.state, y, self.applied]) @ self.step_matrix
        self.residual = total - self.applied  # the command of the frame before
        self.applied = change(self.state @ self.C, self.applied)
        return self.residual


def frames_to_come_back(design, episodes, *, given, seed=0):
    """Return the frames after each episode until its residual stays at the undisturbed one.

    Inf where it does not within three settling times. ``given`` is the estimator form.
    """
    count, rate = len(episodes.gains), design.hardware.frame_rate_hz
    frames = QUIET + LONGEST + 3 * int(np.max(episodes.settling))
    other, free = Run(design, count, given=given), Run(design, count, given=True)
    largest, power = np.zeros((count, 1)), np.zeros(count)
    away = np.zeros(count)
    kind = episodes.kinds[:, None]
    series = disturbances(count, frames, np.random.default_rng(seed), rate)
    with np.errstate(all="ignore"):  # the plain form may grow beyond all numbers
        for k, (total, noise) in enumerate(series):
            limit = 1.2 * np.maximum(largest, 3 * (TURBULENCE_NM + LINE_NM))
            inside = ((k >= QUIET) & (k < episodes.ends))[:, None]

            low = np.where(kind == 0, episodes.depth[:, None] * largest, 0.0)

            def stopped(u, last, inside=inside, limit=limit, low=low):
                here = np.where(kind == 2, last, np.clip(u, -low, low))
                return np.where(inside, here, np.clip(u, -limit, limit))

            found = other.frame(total, noise, episodes.gains, stopped)
            own = free.frame(total, noise, episodes.gains, lambda u, last: u)
            if k < QUIET:
                largest = np.maximum(largest, np.max(np.abs(free.applied), axis=1, keepdims=True))
            power += np.mean(own**2, axis=1)
            apart = np.max(np.abs(found - own), axis=1)
            far = ~(apart <= BACK * np.sqrt(power / (k + 1)))
            away = np.where(far & (k >= episodes.ends), k + 1 - episodes.ends, away)
    return np.where(away >= 3 * episodes.settling, np.inf, away)
