"""Run an exported dao matrix in its own arithmetic, in closed loop, for a million frames.

From the repository::

    python benchmarks/export_dao.py GAIN K_MAT.npy [SENSOR_GAIN...]

The first mode runs in 20 parallel loops of 50,000 frames, in what examples/lbt_robust.yaml calls
the truth: the atmosphere's own spectrum, a vibration of 80 mas at 20 Hz, and noise. Printed per
sensor gain: the residual of the gain file's controller in double precision, that of the matrix in
double precision and in single precision with the twin of the computer's inner loop, and the rms of
the difference of the last two, which is the noise of the arithmetic.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth as lbt
from lbt_synth.interop.dao.export import InnerLoop, direct_form_rows
from lbt_synth.loop.simulation.disturbances import draw_disturbance

LOOPS, FRAMES, SETTLE = 20, 50_000, 5000


class DoubleLoop:
    """The same direct form in double precision, of many loops."""

    def __init__(self, column: npt.NDArray[Any]) -> None:
        self._column, self._first = column.astype(np.float64), len(column) // 2 + 1
        self._memory = np.zeros((len(column), LOOPS))

    def step(self, y: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Take y(k) of all loops, return u(k)."""
        memory, first = self._memory, self._first
        memory[1:first] = memory[: first - 1].copy()
        memory[0] = y
        u = self._column @ memory
        memory[first + 1 :] = memory[first:-1].copy()
        memory[first : first + 1] = u
        return np.asarray(u)


def residuals(
    loop: Any, gain: float, phase: npt.NDArray[Any], noise: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """Return the settled residual of all loops of two frames, (frames, loops) [nm]."""
    residual, held, out = np.zeros(LOOPS), np.zeros(LOOPS), []
    for total, sensed in zip(phase, noise, strict=True):
        u = loop.step(gain * residual + sensed)
        residual, held = total - held, u
        out.append(residual)
    return np.array(out[SETTLE:])


def main() -> None:
    """Print a line per sensor gain."""
    design, matrix = lbt.load_gain(sys.argv[1]), np.load(sys.argv[2])[:, 0]
    own = direct_form_rows(design.controller, len(matrix) // 2)[:, 0]
    config = lbt.load_config("examples/lbt_robust.yaml")
    drawn = draw_disturbance(config.truth, config.hardware, frames=FRAMES + SETTLE, cases=LOOPS)
    phase, noise = drawn.phase_nm[:, :, 0].T, drawn.noise[:, :, 0].T
    print(f"{LOOPS * FRAMES:.0e} frames; residual [nm rms]")
    print("gain   gain file   matrix in double   in single   noise of the arithmetic")
    for gain in [float(text) for text in sys.argv[3:]] or [1.0, 0.7, 0.5, 0.358]:
        loops = (
            DoubleLoop(own),
            DoubleLoop(matrix),
            InnerLoop(np.tile(matrix[:, None], LOOPS)),
        )
        ran = [residuals(loop, gain, phase, noise) for loop in loops]
        sizes = [np.sqrt(np.mean(series**2)) for series in (*ran, ran[2] - ran[1])]
        print("{:<5g} {:10.5g} {:18.5g} {:11.5g} {:13.3g}".format(gain, *sizes))


if __name__ == "__main__":
    main()
