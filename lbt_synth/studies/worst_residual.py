"""A bound on the residual for all frequencies of the lines and all sensor gains at once.

Lines do not change the loop, and independent lines add up: at one gain the worst over all their
frequencies is the sum of the worst of each, a norm over a band. Around a gain, the sensor matrix H
becomes ``(I + E) H`` with a diagonal E, one entry per measurement. With the transfer N from noise
to residual, the residual r0 of ``E = 0`` becomes ``(I + N E H)^-1 r0``: if ``|N E H| <= k < 1`` for
all E of a box, the loop is stable in the whole box and leaves at most ``|r0| / (1 - k)``. The box
with the largest bound is halved until that is close to a residual that occurs.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from lbt_synth.design.shaping.objectives import Skirts
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.linear.held_controller import HasController
from lbt_synth.linear.norms import band_norm
from lbt_synth.linear.quadrature import adaptive_integral
from lbt_synth.loop import ClosedLoop, close_loop, residual_budget
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth, Vibration
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import FloatArray, number, require_instance

_MOST_BOXES = 120  # halved
_COUPLED = 1e-9  # of the largest transfer between axes; less is rounding

Box = tuple[FloatArray, FloatArray]  # least and largest gain of each measurement


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """A vibration, and the band in which it may be."""

    vibration: Vibration | SinusoidalVibration
    direction: FloatArray
    low_hz: float
    high_hz: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GuaranteedResidual:
    """The worst residual over a box of line frequencies and sensor gains."""

    # no point of the box leaves more [nm rms]; inf if the loop is unstable at one, or if halving
    # 120 boxes of gains is too little for any bound
    upper_nm: float
    # the largest found at one set of gains [nm rms]. It occurs where all lines are sinusoids along
    # one axis; for other lines it is a bound at these gains
    value_nm: float
    # the gains of that, one per measurement, relative to the sensor matrix
    sensor_gains: tuple[float, ...]


def guaranteed_residual(
    hardware: LoopHardware,
    controller: Controller | HasController,
    truth: Truth,
    *,
    error_hz: float | tuple[float, float] = 0.0,
    sensor_gains: tuple[float, float] = (1.0, 1.0),
    tolerance: float = 0.01,
) -> GuaranteedResidual:
    """Bound the residual for all line frequencies and sensor gains at once.

    Each line may be anywhere within its own error, and each measurement may have any gain of the
    interval, all independently of each other.

    Parameters
    ----------
    hardware : LoopHardware
        Sensor, mirror and delay.
    controller : Controller or Design
        The controller, or a design that holds it.
    truth : Truth
        Turbulence, noise and vibrations; a resonance counts with its skirts. Its own sensor gain
        is not used.
    error_hz : float or (low, high), optional
        Error of the frequency of the line that moves most [Hz]; the others have their shares
        (:meth:`Truth.frequency_shift_hz`). One number stands for both sides.
    sensor_gains : (low, high), optional
        Interval of the gain of each measurement, relative to the sensor matrix.
    tolerance : float, optional
        Relative distance of ``upper_nm`` from ``value_nm`` at which the search ends; it also ends
        after 120 boxes, which leave some 2 % where the axes are coupled.

    Returns
    -------
    GuaranteedResidual
        The bound, the largest residual found, and where.

    Raises
    ------
    ProblemError
        If the intervals are empty, a vibration drifts, or a line would leave the band.

    Notes
    -----
    Where the axes are decoupled, the gain of one does not touch the others: each axis then has
    its own search, and the bound is the sum.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> design = lbt.kalman(config.plant)
    >>> exact = lbt.residual_budget(lbt.close_loop(config.hardware, design), config.truth)
    >>> found = lbt.studies.guaranteed_residual(config.hardware, design, config.truth)
    >>> bool(abs(found.upper_nm / exact.rms_nm - 1) < 1e-6)
    True
    >>> wide = lbt.studies.guaranteed_residual(
    ...     config.hardware, design, config.truth, error_hz=1.0, sensor_gains=(0.8, 1.2)
    ... )
    >>> round(wide.value_nm), wide.upper_nm / wide.value_nm < 1.01, wide.sensor_gains[0]
    (80, True, 0.8)
    """
    require_instance(hardware, LoopHardware, "hardware")
    require_instance(truth, Truth, "truth")
    low, high = (number(gain, "sensor_gains", above=0) for gain in sensor_gains)
    if low > high:
        raise ProblemError(f"sensor_gains must be (low, high); got {sensor_gains!r}.")
    close = number(tolerance, "tolerance", at_least=1e-6)
    lines = _moving_lines(truth, error_hz, hardware)
    rest = replace(truth, vibrations=(), frequency_errors_hz=None, sensor_gain=1.0)
    q = hardware.n_measurements
    centre = _close(hardware, controller, np.full(q, np.sqrt(low * high)))
    if not centre.is_stable:
        gains = (float(np.sqrt(low * high)),) * q
        return GuaranteedResidual(upper_nm=np.inf, value_nm=np.inf, sensor_gains=gains)
    upper = value = 0.0
    worst = np.empty(q)
    for rows in _independent_axes(centre):
        size = 1 if len(rows) < q else q

        def judge(box: Box, rows: list[int] = rows) -> tuple[float, float]:
            gains = np.broadcast_to((box[0] + box[1]) / 2, (q,))
            return _judge_box(_close(hardware, controller, gains), rows, box, rest, lines)

        start = np.full(size, low), np.full(size, high)
        part = _branch_and_bound(judge, start, 2 * close)
        upper, value = upper + part[0], value + part[1]
        worst[rows if size == 1 else slice(None)] = part[2]
    return GuaranteedResidual(
        upper_nm=float(np.sqrt(upper)),
        value_nm=float(np.sqrt(value)),
        sensor_gains=tuple(worst.tolist()),
    )


def _branch_and_bound(
    judge: Callable[[Box], tuple[float, float]], start: Box, gap: float
) -> tuple[float, float, FloatArray]:
    """Halve the box of the largest bound; return the bound, the largest value and its place."""
    corners = [(start[0], start[0]), (start[1], start[1])]  # the worst is often an end
    best, place = max(((judge(box)[1], box[0]) for box in corners), key=lambda found: found[0])
    order = count()  # boxes themselves are not compared
    upper, value = judge(start)
    boxes = [(-upper, next(order), start)]
    for _ in range(_MOST_BOXES):
        if not np.isfinite(best):
            return np.inf, np.inf, place
        upper, (low, high) = -boxes[0][0], boxes[0][2]
        if upper <= best * (1 + gap):
            break
        heapq.heappop(boxes)
        side = int(np.argmax(high / low))
        middle = np.sqrt(low[side] * high[side])
        for end, its in ((high, high.copy()), (low, low.copy())):
            its[side] = middle
            box = (low, its) if end is high else (its, high)
            upper, value = judge(box)
            heapq.heappush(boxes, (-upper, next(order), box))
            if value > best:
                best, place = value, (box[0] + box[1]) / 2
    return max(-boxes[0][0], best), best, place


def _judge_box(
    loop: ClosedLoop, rows: list[int], box: Box, rest: Truth, lines: list[_Line]
) -> tuple[float, float]:
    """Return a bound over a box of gains and the value at its centre, of some axes [nm^2]."""
    if not loop.is_stable:
        return np.inf, np.inf
    low, high = box
    relative = np.broadcast_to((high - low) / (high + low), (loop.hardware.n_measurements,))
    noise = loop.noise_propagation()
    # of one axis alone, its own measurement
    own = rows if low.size < relative.size else list(range(relative.size))
    reach = replace(
        noise,
        B=noise.B[:, own] * relative[own],
        C=noise.C[rows],
        D=noise.D[np.ix_(rows, own)] * relative[own],
    )
    share = 0.0
    if np.any(relative > 0):
        share = hinf_norm(reach).upper * float(np.linalg.norm(loop.hardware.sensor[own], 2))
    budget = residual_budget(loop, rest, frame_means=True)
    value = float(np.trace((budget.turbulence_nm2 + budget.noise_nm2)[np.ix_(rows, rows)]))
    # a line across leaves rounding alone, on which no quadrature settles
    felt = (line for line in lines if np.any(line.direction[rows]))
    value += sum(_worst_of_line(loop, rows, line) for line in felt)
    return (value / (1 - share) ** 2 if share < 1 else np.inf), value


def _worst_of_line(loop: ClosedLoop, rows: list[int], line: _Line) -> float:
    """Return the worst variance of a line in its band, with its skirts outside [nm^2]."""
    whole = loop.rejection()
    response = replace(
        whole,
        B=whole.B @ line.direction[:, None],
        C=whole.C[rows],
        D=(whole.D @ line.direction[:, None])[rows],
    )
    peak = band_norm(response, line.low_hz, line.high_hz).upper
    found = (line.vibration.rms_nm * peak) ** 2
    return found + _left_of_skirts(loop, response, line)


def _left_of_skirts(loop: ClosedLoop, response: StateSpace, line: _Line) -> float:
    """Return what is left of a resonance outside its band, at most [nm^2]; 0 for a sinusoid."""
    if not isinstance(line.vibration, Vibration):
        return 0.0
    low, high, rate = line.low_hz, line.high_hz, loop.hardware.frame_rate_hz
    size = {"rms_nm": line.vibration.rms_nm, "damping": line.vibration.damping}
    skirts = Skirts(low_hz=low, high_hz=high, frame_rate_hz=rate, **size)

    def density(f: FloatArray) -> FloatArray:
        power = np.sum(np.abs(response.frequency_response(f)[:, :, 0]) ** 2, axis=1)
        return np.asarray((skirts.psd(f) * power)[:, None, None])

    nyquist = rate / 2
    edges = np.concatenate([resonance_edges(loop), np.clip(skirts.breakpoints_hz, 0, nyquist)])
    return float(adaptive_integral(density, np.unique(edges))[0, 0])


def _close(
    hardware: LoopHardware, controller: Controller | HasController, gains: FloatArray
) -> ClosedLoop:
    """Close the loop with a gain for each measurement."""
    return close_loop(replace(hardware, sensor_matrix=gains[:, None] * hardware.sensor), controller)


def _independent_axes(loop: ClosedLoop) -> list[list[int]]:
    """Return the axes that no gain of another one touches; all of them together if one does."""
    modes, q = loop.hardware.modes, loop.hardware.n_measurements
    together = [list(range(modes))]
    if modes != q:
        return together
    noise, sensor = loop.noise_propagation(), loop.hardware.sensor
    largest = hinf_norm(noise).value * float(np.linalg.norm(sensor, 2))
    for i in range(modes):
        others = [j for j in range(modes) if j != i]
        across = replace(noise, B=noise.B[:, others], C=noise.C[[i]], D=noise.D[[i]][:, others])
        between = float(np.abs(sensor[i, others]).max(initial=0.0))
        if others and max(hinf_norm(across).value, between) > _COUPLED * largest:
            return together
    return [[i] for i in range(modes)]


def _moving_lines(
    truth: Truth, error_hz: float | tuple[float, float], hardware: LoopHardware
) -> list[_Line]:
    """Return the vibrations with the bands in which they may be."""
    if isinstance(error_hz, tuple):
        first, last = (number(end, "error_hz") for end in error_hz)
    else:
        last = number(error_hz, "error_hz", at_least=0)
        first = -last
    if first > last:
        raise ProblemError(f"error_hz must be one number, or (low, high); got {error_hz!r}.")
    lines, nyquist = [], hardware.frame_rate_hz / 2
    shifts = zip(*(truth.frequency_shifts_hz(end) for end in (first, last)), strict=True)
    for vibration, moved in zip(stationary_vibrations(truth.vibrations), shifts, strict=True):
        f = vibration.frequency_hz
        low, high = (f + float(shift) for shift in moved)
        if not 0 < low <= high < nyquist:
            raise ProblemError(
                f"error_hz must leave each vibration between 0 and {nyquist:.6g} Hz; got the one "
                f"at {f:.6g} Hz in {low:.6g} to {high:.6g} Hz. Try a smaller error."
            )
        direction = checked_direction(vibration, hardware)
        lines.append(_Line(vibration=vibration, direction=direction, low_hz=low, high_hz=high))
    return lines
