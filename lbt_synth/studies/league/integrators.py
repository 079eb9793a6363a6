"""Integrators whose gains are the best for a spectrum, or in hindsight."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from lbt_synth.design.integrator import TRIED_GAINS, hardware_gain_limit
from lbt_synth.identification import ForwardSplit
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray

_TRIALS = 24


def optimised_integrators(split: ForwardSplit) -> Controller:
    """Return the integrators of least residual, by the periodogram of the training.

    One gain per axis (E. Gendron, P. Lena, Astron. Astrophys. 291, 337 (1994)).
    """
    single, rate = split.hardware.single_mode(), split.hardware.frame_rate_hz
    gains = []
    for series in split.open_loop.T:
        found = loop_periodogram(series, None, frame_rate_hz=rate, stretches=split.training)
        late = np.exp(-2j * np.pi * found.frequency_hz / rate)
        path = sum(tap * late ** (i + 1) for i, tap in enumerate(single.mirror_taps))

        def left(
            gain: float,
            late: FloatArray = late,
            path: FloatArray = path,
            power: FloatArray = found.measured,
        ) -> float:
            return float(np.sum(power * np.abs((1 - late) / (1 - late + gain * path)) ** 2))

        gains.append(_best_gain(left, single))
    return _integrators(split.hardware, gains)


def hindsight_integrators(split: ForwardSplit) -> Controller:
    """Return the integrators, one gain per axis, that leave least of the test itself."""
    single = split.hardware.single_mode()
    gains = []
    for axis in range(split.hardware.modes):

        def left(gain: float, axis: int = axis) -> float:
            controller = _integrators(split.hardware, [gain] * split.hardware.modes)
            return float(np.mean(split.replay(controller)[:, axis] ** 2))

        gains.append(_best_gain(left, single))
    return _integrators(split.hardware, gains)


def _best_gain(left: Callable[[float], float], single: LoopHardware) -> float:
    """Search a grid of gains below the limit of stability for the least, and refine it."""
    trials = np.log(np.geomspace(*TRIED_GAINS, _TRIALS) * hardware_gain_limit(single))
    values = [left(float(np.exp(trial))) for trial in trials]
    best = int(np.argmin(values))
    bracket = trials[max(best - 1, 0)], trials[min(best + 1, _TRIALS - 1)]
    found = minimize_scalar(
        lambda x: left(float(np.exp(x))), bounds=bracket, method="bounded", options={"xatol": 1e-3}
    )
    return float(np.exp(found.x))


def _integrators(hardware: LoopHardware, gains: list[float]) -> Controller:
    """Return an integrator per axis, for measurements that see one axis each."""
    each = np.eye(len(gains))
    return Controller(
        A=each,
        B=np.diag(gains) @ np.linalg.inv(hardware.sensor),
        C=each,
        D=np.zeros_like(each),
        dt_s=hardware.dt_s,
    )
