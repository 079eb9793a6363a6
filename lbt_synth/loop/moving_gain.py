"""What a loop stands of a sensor gain that moves in time: proved, and disproved by a sequence."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.moving_parameter.destabilising import destabilising_sequence
from lbt_synth.linear.moving_parameter.family import ParameterFamily
from lbt_synth.linear.moving_parameter.stability_proof import prove_any_speed, prove_rate
from lbt_synth.loop.closed_loop import ClosedLoop, checked_loop_matrices
from lbt_synth.loop.margins import stable_sensor_gains
from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import number, require_instance

RATE_PER_S = 1.0  # the optical gain of a pyramid follows the seeing, which takes seconds
_WIDEST = 100.0  # factor on the loop's gain beyond which none is looked at


@table_row
class MovingGain(Summarised):
    """Intervals of a sensor gain that moves in time; nan where nothing is proved.

    Proofs are Lyapunov functions, checked with bounds on rounding. A gain that does not move may
    be anywhere in the first interval.
    """

    constant_low: float = column("stable at each constant gain, from")
    constant_high: float = column("  to")
    slow_low: float = column("proved while the gain moves slowly, from")
    slow_high: float = column("  to")
    rate_per_s: float = column("  by at most", unit="1/s", help="Fastest change of the slow gain")
    fast_low: float = column("proved while it moves at any speed, from")
    fast_high: float = column("  to")
    broken_low: float | None = column("destabilised by a moving gain, from", default=None)
    broken_high: float | None = column("  to", default=None)
    broken_frames: int | None = column("  with a period of", unit="frames", default=None)

    def _brief(self) -> str:
        return f"any speed {self.fast_low:.4g} to {self.fast_high:.4g}"

    def _summarise(self) -> Summary:
        return Summary(tables=[fact_table("Sensor gain that moves", self)])


def moving_gain(loop: ClosedLoop, *, rate_per_s: float = RATE_PER_S) -> MovingGain:
    """Find intervals of a moving sensor gain that are proved, and one that is disproved.

    The intervals for any speed are around the loop's own gain, with the same share of the
    interval of constant gains, in logarithms, on both sides.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, stable at its sensor gain.
    rate_per_s : float, optional
        Fastest change of the slow gain [1/s]; 1 moves from 0.3 to 0.8 in half a second.

    Returns
    -------
    MovingGain
        The intervals, in sensor gains relative to the sensor matrix.

    Raises
    ------
    UnstableLoopError
        If the loop is not stable.
    ProblemError
        If the rate is not positive.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> moving = lbt.loop.moving_gain(lbt.close_loop(path, lazy))
    >>> round(moving.constant_high, 3), moving.slow_high > 1.98, moving.fast_high > 1.2
    (2.0, True, True)
    """
    require_instance(loop, ClosedLoop, "loop")
    rate = number(rate_per_s, "rate_per_s", above=0)
    loop.require_stable()
    nominal, hardware = loop.sensor_gain, loop.hardware
    constant = stable_sensor_gains(hardware, loop.controller, nominal=nominal)
    low, high = max(constant[0], nominal / _WIDEST), min(constant[1], nominal * _WIDEST)
    A0, A1, *_ = checked_loop_matrices(hardware, loop.controller)
    within = {"low": low, "high": high, "nominal": nominal}
    fast = prove_any_speed(A0, A1, **within)
    family = ParameterFamily.affine(A0, A1, low=low, high=high)
    slow = prove_rate(family, rate=rate * hardware.dt_s, nominal=nominal)
    proofs = [proof for proof in (slow, fast) if proof is not None]
    widest = max(proofs, key=lambda proof: proof.high / proof.low, default=None)
    broken = destabilising_sequence(A0, A1, **within)
    return MovingGain(
        constant_low=constant[0],
        constant_high=constant[1],
        slow_low=np.nan if widest is None else widest.low,
        slow_high=np.nan if widest is None else widest.high,
        rate_per_s=rate,
        fast_low=np.nan if fast is None else fast.low,
        fast_high=np.nan if fast is None else fast.high,
        broken_low=None if broken is None else broken.low,
        broken_high=None if broken is None else broken.high,
        broken_frames=None if broken is None else broken.at_high.size,
    )
