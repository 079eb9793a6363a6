"""Run exported dao matrices in their own arithmetic, in closed loop, for a million frames.

From the repository::

    python benchmarks/export_dao.py K_MAT.npy [SENSOR_GAIN...]

The mode of the first column runs in parallel loops of two frames' delay at 800 Hz: a random walk
held by a leak, a vibration between 16.5 and 23.5 Hz and noise. Printed per sensor gain: the
residual in single precision with the twin of the RTC's inner loop, the residual with the same
coefficients in double precision, and the rms of the difference, which is the arithmetic's noise.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.interop.dao.inner_loop import InnerLoop

LOOPS, FRAMES, SETTLE, RATE_HZ = 500, 2000, 1000, 800.0
TURBULENCE_NM, VIBRATION_NM, NOISE_NM, POLE = 592.0, 797.0, 15.5, 0.9886


def disturbance(rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return the phase of each loop, (frames, loops) [nm]."""
    total = FRAMES + SETTLE
    air = rng.standard_normal((total, LOOPS)) * np.sqrt(1 - POLE**2)
    air[0] = rng.standard_normal(LOOPS)
    for k in range(1, total):
        air[k] += POLE * air[k - 1]
    turns = rng.uniform(16.5, 23.5, LOOPS) / RATE_HZ * np.arange(total)[:, None]
    line = np.sqrt(2) * np.sin(2 * np.pi * (turns + rng.uniform(size=LOOPS)))
    return np.asarray(TURBULENCE_NM * air + VIBRATION_NM * line)


def double_step(column: npt.NDArray[Any], memory: npt.NDArray[Any], y: Any) -> Any:
    """Step the same direct form in double precision; the memory is (2 M + 1, loops)."""
    first = len(column) // 2 + 1
    memory[1:first] = memory[: first - 1].copy()
    memory[0] = y
    u = column @ memory
    memory[first + 1 :] = memory[first:-1].copy()
    memory[first : first + 1] = u
    return u


def residuals(column: npt.NDArray[Any], gain: float, *, single: bool) -> npt.NDArray[Any]:
    """Return the settled residual of all loops, (frames, loops) [nm]."""
    rng = np.random.default_rng(0)
    phase = disturbance(rng)
    loop = InnerLoop(np.tile(column[:, None], LOOPS), np.zeros((1, LOOPS)))
    memory = np.zeros((len(column), LOOPS))
    wide = column.astype(np.float64)
    residual, held, out = np.zeros(LOOPS), np.zeros(LOOPS), []
    for total in phase:
        y = gain * residual + NOISE_NM * rng.standard_normal(LOOPS)
        u = loop.step(y) if single else double_step(wide, memory, y)
        residual, held = total - held, u
        out.append(residual)
    return np.array(out[SETTLE:])


def main() -> None:
    """Print a line per sensor gain."""
    column = np.load(sys.argv[1])[:, 0]
    print(f"{LOOPS * FRAMES:.0e} frames; residual [nm rms]")
    print("gain   single   double   difference")
    for gain in [float(text) for text in sys.argv[2:]] or [1.0, 0.7, 0.5, 0.358]:
        found, wide = (residuals(column, gain, single=single) for single in (True, False))
        apart = np.sqrt(np.mean((found - wide) ** 2))
        sizes = (np.sqrt(np.mean(series**2)) for series in (found, wide))
        print(f"{gain:<6g} " + "   ".join(f"{size:.5g}" for size in sizes) + f"   {apart:.3g}")


if __name__ == "__main__":
    main()
