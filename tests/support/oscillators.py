"""Continuous oscillators, shaken by kicks within each frame, without the package's sampling."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm


@dataclass(frozen=True)
class KickedOscillator:
    """An oscillator over a frame: its state is position and velocity over w0 at the end of a frame.

    A force is white where its kicks are at the nodes of a Gauss rule, whose weights are their
    powers: what covariances integrate is smooth between the ends of steps.
    """

    angle: float  # w0 T
    damping: float
    rms_nm: float
    steps: int = 64  # of a frame, with four kicks each

    @property
    def _rates(self) -> np.ndarray:
        return self.angle * np.array([[0.0, 1.0], [-1.0, -2 * self.damping]])

    def _over(self, time: float) -> np.ndarray:
        return expm(self._rates * time)

    def _integral(self, time: float) -> np.ndarray:
        return np.linalg.solve(self._rates, self._over(time) - np.eye(2))[0]

    @property
    def kicks(self) -> tuple[np.ndarray, np.ndarray]:
        """Times in a frame, and sizes."""
        nodes, weights = np.polynomial.legendre.leggauss(4)
        times = (np.arange(self.steps)[:, None] + (nodes + 1) / 2) / self.steps
        powers = 4 * self.damping * self.angle * self.rms_nm**2 * weights / (2 * self.steps)
        return times.ravel(), np.sqrt(np.tile(powers, self.steps))

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps (2, 2), (2, kicks) to the state at a time of a frame."""
        times, sizes = self.kicks
        late = [self._over(time - s)[:, 1] if s < time else np.zeros(2) for s in times]
        return self._over(time), np.array(late).T * sizes

    def mean(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps (2,), (kicks,) to the mean position in a frame."""
        times, sizes = self.kicks
        return self._integral(1.0), np.array([self._integral(1 - s)[1] for s in times]) * sizes

    def chain(self, part: float, remembered: int) -> tuple[np.ndarray, np.ndarray]:
        """Return A, B of [state at the end (2), mean, the one before, states at a part, newest first]."""
        size = 4 + 2 * remembered
        (over, kicked), (mean, mean_kicked) = self.at(1.0), self.mean()
        A, B = np.zeros((size, size)), np.zeros((size, kicked.shape[1]))
        A[:2, :2], B[:2], A[2, :2], B[2], A[3, 2] = over, kicked, mean, mean_kicked, 1.0
        A[4:6, :2], B[4:6] = self.at(part)
        A[6:, 4:-2] = np.eye(size - 6)
        return A, B

    def paths(self, part: float, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Return means (frames, kicks) and states (frames, kicks, 2) after each kick of frame 0."""
        A, state = self.chain(part, 1)
        positions, states = np.empty((frames, state.shape[1])), []
        for k in range(frames):
            positions[k] = state[2]
            states.append(state[4:6].T)
            state = A @ state
        return positions, np.array(states)

    def draw(self, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return mean positions and mean accelerations over w0^2 of frames, (frames,) each."""
        A, B = self.chain(1.0, 2)
        drives = rng.standard_normal((frames, B.shape[1])) @ B.T
        state, states = np.zeros(len(A)), np.empty((frames, len(A)))
        state[[0, 1, 4, 5]] = np.tile(self.rms_nm * rng.standard_normal(2), 2)
        for k, drive in enumerate(drives):
            state = states[k] = A @ state + drive
        return states[:, 2], (states[:, 5] - states[:, 7]) / self.angle
