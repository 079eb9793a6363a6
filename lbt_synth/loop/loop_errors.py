"""Loops whose sensor gain and delay are not those assumed: which errors a loop survives together.

With the mirror's response ``M_d`` at a delay d, a loop that is stable at the gain 1 and the delay d
is stable at g and ``d'`` while ``I + X`` does not vanish on the unit circle, where X is ``z^-1 (g
M_d' - M_d)`` times what commands answer to noise, as the sensor sees it. It does not while the
Hermitian part of X lies above -1. ``M_d'`` is piecewise linear in ``d'``, so that a few loops stand
for all of a box of gains and delays: X of any other is an average of theirs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polysub

from lbt_synth.linear import StateSpace
from lbt_synth.linear.norms import largest_real_part, square_parts
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import instant_mirror, tapped_mirror
from lbt_synth.validation import FloatArray

# a loop of another gain, over the one assumed, and delay [frames], and taps of
# ``z^-1 (M_d - g M_d')``, (t,)
LoopChange: TypeAlias = tuple[float, float, FloatArray]

FRAGILE_FRAMES = 0.1  # of delay: what a camera's clock or a busy computer adds
FRAGILE_DB = 2.0  # of the sensor gain: what the seeing changes within minutes
_MOST = 10.0  # times these errors: one frame, and a factor of 10
_POINTS = 400  # frequencies at which a box is sought, before it is proved
_LEVEL = 1 - 1e-6  # of the real part, below which one is proved to stay
_CLOSE = 0.99  # of a box whose sides touch the border, between the points, too
_SHRINK = 0.97  # of a box that is not proved


def loop_changes(
    hardware: LoopHardware, *, low: float, high: float, delay_frames: float
) -> list[LoopChange]:
    """Return the loops that stand for all gains of an interval, and delays within an error.

    The mirror settles at once if the delay has an error. A delay below one frame does not occur.
    """
    d, own = hardware.delay_frames, hardware.mirror_taps
    early, late = max(d - delay_frames, 1.0), d + delay_frames
    whole = np.arange(np.ceil(early), np.floor(late) + 1).tolist()
    delays = {early, late, *whole} if delay_frames else {d}
    changes = []
    for gain in sorted({low, high}):
        for delay in sorted(delays):
            if (gain, delay) == (1, d):
                continue
            there = own if delay == d else instant_mirror(delay).taps
            taps = np.concatenate([[0.0], polysub(own, gain * there)])
            changes.append((gain, delay, taps))
    return changes


def append_taps(system: StateSpace, taps: FloatArray) -> StateSpace:
    """Return a system whose outputs go through ``taps[0] + taps[1] z^-1 + ...``."""
    late, p = tapped_mirror(taps), len(system.C)
    A, entry, output = late.repeated(p)
    none = np.zeros((system.n_states, len(A)))
    return StateSpace(
        A=np.block([[system.A, none], [entry @ system.C, A]]),
        B=np.vstack([system.B, entry @ system.D]),
        C=np.hstack([late.D * system.C, output]),
        D=late.D * system.D,
        dt_s=system.dt_s,
    )


def errors_together(loop: ClosedLoop) -> float:
    """Return how many times 0.1 frames and 2 dB, at once, leave a stable loop stable: proved.

    All delays within the error, late or early, and all gains within the factor count, at most 10
    times. It is nan for a mirror with dynamics, whose response is not linear in the delay.
    """
    hardware = loop.hardware
    if hardware.mirror is not None:
        return float("nan")
    answer = _answer_to_noise(loop)
    rate = hardware.frame_rate_hz
    f = np.concatenate([np.geomspace(1e-3, 1, _POINTS // 4), np.linspace(0.01, 1, _POINTS)])
    f = np.concatenate([f, np.abs(np.angle(answer.poles)) / np.pi]) * rate / 2
    points = np.maximum(f, 1e-9 * rate)
    parts = square_parts(answer)
    responses = [part.frequency_response(points) for part in parts]
    turns = np.exp(-2j * np.pi * f / rate)[:, None]

    def changes(scale: float) -> list[LoopChange]:
        factor = 10 ** (scale * FRAGILE_DB / 20)
        late = scale * FRAGILE_FRAMES
        return loop_changes(hardware, low=1 / factor, high=factor, delay_frames=late)

    def seems_stable(scale: float) -> bool:
        for *_, taps in changes(scale):
            shift = turns ** np.arange(taps.size) @ taps
            for response in responses:
                X = shift[:, None, None] * response
                if np.max(np.linalg.eigvalsh(X + X.conj().transpose(0, 2, 1))) >= 2:
                    return False
        return True

    low, high = 0.0, _MOST
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if seems_stable(middle) else (low, middle)
    scale = high if seems_stable(high) else low * _CLOSE
    while scale > 1e-3:
        pairs = ((part, taps) for *_, taps in changes(scale) for part in parts)
        systems = (append_taps(part, taps) for part, taps in pairs)
        if all(largest_real_part(system, least=_LEVEL) < 1 for system in systems):
            return scale
        scale *= _SHRINK
    return 0.0


def _answer_to_noise(loop: ClosedLoop) -> StateSpace:
    """Return the system from the noise to what the sensor sees of the commands it causes."""
    hardware, commanding = loop.hardware, loop.commanding()
    n, seen = hardware.modes, loop.sensor_gain * hardware.sensor @ hardware.influence
    return replace(
        commanding,
        B=commanding.B[:, n:],
        C=seen @ commanding.C,
        D=seen @ commanding.D[:, n:],
    )
