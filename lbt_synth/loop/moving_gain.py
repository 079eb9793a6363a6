"""A sensor gain that moves at any speed: stability proved by the circle criterion.

At the gain c the measurement feeds back through the complementary sensitivity T. A gain that moves
between ``c (1 - r)`` and ``c (1 + r)`` adds the feedback ``d(k) T`` with ``|d(k)| <= r``, so the
loop is stable, whatever d does, if it is stable at c and ``r ||T||_inf < 1``. By the bounded real
lemma one quadratic Lyapunov function then decreases at every gain of the interval; through one
measurement it exists for no wider interval (P. P. Khargonekar, I. R. Petersen, K. Zhou, IEEE Trans.
Autom. Control 35, 356 (1990), doi:10.1109/9.50357). The norm is bracketed by level sets.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.linear import hinf_norm
from lbt_synth.loop.closed_loop import ClosedLoop, close_loop
from lbt_synth.loop.margins import stable_sensor_gains
from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import require_instance

# Largest norm that counts as below 1: a norm is accurate to 1e-7 with a pole at 1 - 1e-9, and a
# loop with a pole nearer to the unit circle does not count as stable.
CIRCLE_LIMIT = 1 - 1e-7
_WIDEST = 100.0  # factor on the loop's gain beyond which no pyramid's optical gain lies
_BISECTIONS = 10  # of the share of an interval: the ends are then exact to 1 % or better


@table_row
class MovingGain(Summarised):
    """Intervals of a constant and of a moving sensor gain; nan where nothing is proved.

    A gain that does not move may be anywhere in the first interval. Around the loop's own gain,
    the second has the same share of the first, in logarithms, on both sides.
    """

    constant_low: float = column("stable at each constant gain, from")
    constant_high: float = column("  to")
    moving_low: float = column("proved while it moves at any speed, from")
    moving_high: float = column("  to")

    def _brief(self) -> str:
        return f"any speed {self.moving_low:.4g} to {self.moving_high:.4g}"

    def _summarise(self) -> Summary:
        return Summary(tables=[fact_table("Sensor gain that moves", self)])


def circle_norm(loop: ClosedLoop, *, low: float, high: float) -> float:
    """Return ``r ||T||_inf`` of an interval of gains, which proves it below ``CIRCLE_LIMIT``.

    It is inf where the loop is not stable at the middle of the interval.
    """
    middle = (low + high) / 2
    centred = close_loop(loop.hardware, loop.controller, sensor_gain=middle)
    if not centred.is_stable:
        return np.inf
    S = centred.output_sensitivity()
    T = replace(S, C=-S.C, D=np.eye(len(S.D)) - S.D)
    return (high - low) / (2 * middle) * hinf_norm(T).upper


def moving_gain(loop: ClosedLoop) -> MovingGain:
    """Find the interval of a moving sensor gain in which a loop is proved stable.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, stable at its sensor gain.

    Returns
    -------
    MovingGain
        The intervals, in sensor gains relative to the sensor matrix.

    Raises
    ------
    UnstableLoopError
        If the loop is not stable.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> moving = lbt.loop.moving_gain(lbt.close_loop(path, lazy))
    >>> round(moving.constant_high, 3), round(moving.moving_low, 3), round(moving.moving_high, 3)
    (2.0, 0.06, 1.527)
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    nominal = loop.sensor_gain
    constant = stable_sensor_gains(loop.hardware, loop.controller, nominal=nominal)
    ends = np.array([max(constant[0], nominal / _WIDEST), min(constant[1], nominal * _WIDEST)])

    def interval(share: float) -> tuple[float, float]:
        low, high = nominal * (ends / nominal) ** share
        return float(low), float(high)

    def proves(share: float) -> bool:
        low, high = interval(share)
        return circle_norm(loop, low=low, high=high) < CIRCLE_LIMIT

    proved, failed = (1.0, 1.0) if proves(1.0) else (0.0, 1.0)
    for _ in range(_BISECTIONS if proved < failed else 0):
        middle = (proved + failed) / 2
        proved, failed = (middle, failed) if proves(middle) else (proved, middle)
    low, high = interval(proved) if proved else (np.nan, np.nan)
    return MovingGain(
        constant_low=constant[0],
        constant_high=constant[1],
        moving_low=low,
        moving_high=high,
    )
