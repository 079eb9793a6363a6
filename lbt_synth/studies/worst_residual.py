"""A bound on the residual for all frequencies of the lines and all sensor gains at once.

Lines do not change the loop, and independent lines add up: at one gain the worst over all their
frequencies is the sum of the worst of each, a norm over a band. Around a gain, the sensor matrix H
becomes ``(I + E) H`` with a diagonal E, one entry per measurement. With the transfer N from noise
to residual, the residual r0 of ``E = 0`` becomes ``(I + N E H)^-1 r0``: if ``|N E H| <= k < 1`` for
all E of a box, the loop is stable in the whole box and leaves at most ``|r0| / (1 - k)``. The box
with the largest bound is halved until that is close to a residual that occurs.

That is the residual of means over frames. With a settled mirror and a whole delay, what moves
within frames is added: no command and no gain changes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design.shaping.objectives import Skirts
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, hinf_norm
from lbt_synth.linear.held_controller import HasController
from lbt_synth.linear.norms import band_norm
from lbt_synth.linear.quadrature import adaptive_integral
from lbt_synth.loop import ClosedLoop, close_loop, residual_budget
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.evaluator import power_within_frames
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth, Vibration
from lbt_synth.studies.robustness import moved_lines
from lbt_synth.validation import FloatArray, number, require_instance

_MOST_BOXES = 120  # halved
_PLACES = 17  # of a resonance in its band
_COUPLED = 1e-9  # of the largest transfer between axes; less is rounding

Box = tuple[FloatArray, FloatArray]  # least and largest gain of each measurement, (q,)
Line = Vibration | SinusoidalVibration


@dataclass(frozen=True, slots=True, kw_only=True)
class GuaranteedResidual:
    """The worst residual over a box of line frequencies and sensor gains."""

    # no point of the box leaves more [nm rms]; inf if the loop is unstable at one, or if halving
    # 120 boxes of gains is too little for any bound
    upper_nm: float
    # the largest found at one set of gains [nm rms]. It occurs where all lines are sinusoids at
    # their own frequencies along one axis; for other lines it is a bound at these gains
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
        If the intervals are empty, a vibration drifts, a line would leave the band, or the loop
        has a mirror with dynamics or a fractional delay.

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
    (88, True, 0.8)
    """
    require_instance(hardware, LoopHardware, "hardware")
    require_instance(truth, Truth, "truth")
    if not has_guarantee(hardware):
        mirror = "one with dynamics" if hardware.mirror else "a settled one"
        raise ProblemError(
            "the guarantee in the image is known for a settled mirror and a whole delay; got "
            f"{mirror} and {hardware.delay_frames:g} frames."
        )
    low, high = (number(gain, "sensor_gains", above=0) for gain in sensor_gains)
    if low > high:
        raise ProblemError(f"sensor_gains must be (low, high); got {sensor_gains!r}.")
    close = number(tolerance, "tolerance", at_least=1e-6)
    ends = error_hz if isinstance(error_hz, tuple) else (-number(error_hz, "error_hz"), error_hz)
    first, last = (number(end, "error_hz") for end in ends)
    if first > last:
        raise ProblemError(f"error_hz must be at least 0, or (low, high); got {error_hz!r}.")
    lines = moved_lines(truth, (first, last), hardware, "error_hz")
    rest = replace(truth, vibrations=(), frequency_errors_hz=None, sensor_gain=1.0)
    middle = np.full(hardware.n_measurements, np.sqrt(low * high))
    centre = _close(hardware, controller, middle)
    if not centre.is_stable:
        return GuaranteedResidual(
            upper_nm=np.inf, value_nm=np.inf, sensor_gains=tuple(middle.tolist())
        )
    upper = value = 0.0
    worst = middle.copy()
    for axes, measurements in _independent_axes(centre):

        def judge(box: Box, axes: list[int] = axes) -> tuple[float, float]:
            loop = _close(hardware, controller, (box[0] + box[1]) / 2)
            return _judge_box(loop, axes, box, rest, lines)

        start = middle.copy(), middle.copy()
        start[0][measurements], start[1][measurements] = low, high
        bound, largest, gains = _branch_and_bound(judge, start, 2 * close)
        upper, value = upper + bound, value + largest
        worst[measurements] = gains[measurements]
    return GuaranteedResidual(
        upper_nm=float(np.sqrt(upper)),
        value_nm=float(np.sqrt(value)),
        sensor_gains=tuple(worst.tolist()),
    )


def has_guarantee(hardware: LoopHardware) -> bool:
    """Whether a guarantee in the image is known for a loop: a settled mirror, a whole delay."""
    return hardware.mirror is None and hardware.delay_frames % 1 == 0


def _branch_and_bound(
    judge: Callable[[Box], tuple[float, float]], start: Box, gap: float
) -> tuple[float, float, FloatArray]:
    """Halve the box of the largest bound; return the bound, the largest value and its place."""
    ends = [(judge((end, end))[1], end) for end in start]  # the worst is often an end
    best, place = max(ends, key=lambda pair: pair[0])
    boxes: list[tuple[float, Box]] = []
    halves = [start]
    while True:
        for box in halves:
            upper, value = judge(box)
            boxes.append((upper, box))
            if value > best:
                best, place = value, (box[0] + box[1]) / 2
        if not np.isfinite(best):
            return np.inf, np.inf, place
        widest = int(np.argmax([upper for upper, _ in boxes]))
        upper, (low, high) = boxes.pop(widest)
        if upper <= best * (1 + gap) or len(boxes) >= _MOST_BOXES:
            return max(upper, best), best, place
        side = int(np.argmax(high / low))
        low_half, high_half = high.copy(), low.copy()
        low_half[side] = high_half[side] = np.sqrt(low[side] * high[side])
        halves = [(low, low_half), (high_half, high)]


def _judge_box(
    loop: ClosedLoop, axes: list[int], box: Box, rest: Truth, lines: list[tuple[Line, FloatArray]]
) -> tuple[float, float]:
    """Return a bound over a box of gains and the value at its centre, of some axes [nm^2]."""
    if not loop.is_stable:
        return np.inf, np.inf
    relative = (box[1] - box[0]) / (box[1] + box[0])
    moving, noise = np.flatnonzero(relative).tolist(), loop.noise_propagation()
    share = 0.0
    if moving:
        reach = replace(
            noise,
            B=noise.B[:, moving] * relative[moving],
            C=noise.C[axes],
            D=noise.D[np.ix_(axes, moving)] * relative[moving],
        )
        share = hinf_norm(reach).upper * float(np.linalg.norm(loop.hardware.sensor[moving], 2))
    budget, own = residual_budget(loop, rest), np.ix_(axes, axes)
    means = float(np.trace((budget.turbulence_nm2 + budget.noise_nm2)[own]))
    within, rate = float(np.trace(budget.within_nm2[own])), loop.hardware.frame_rate_hz
    for line, (low_hz, high_hz) in lines:
        along = np.asarray(line.direction)[axes]
        if np.any(along):  # a line across leaves rounding alone, on which no quadrature settles
            sampled = replace(line, rms_nm=line.rms_nm * float(np.sinc(low_hz / rate)))
            means += _worst_of_line(loop, axes, sampled, float(low_hz), float(high_hz))
            within += float(along @ along) * _most_within(line, low_hz, high_hz, rate)
    return (means / (1 - share) ** 2 if share < 1 else np.inf) + within, means + within


def _most_within(line: Line, low_hz: float, high_hz: float, rate_hz: float) -> float:
    """Return the most of a line in its band that moves within frames [nm^2]."""
    if isinstance(line, SinusoidalVibration):
        return float(line.rms_nm**2 * (1 - np.sinc(high_hz / rate_hz) ** 2))
    places = np.linspace(low_hz, high_hz, _PLACES if low_hz < high_hz else 1)
    rms_nm = line.rms_nm * np.sinc(places / rate_hz)
    models = [
        replace(line, frequency_hz=place, rms_nm=rms).ar_model(rate_hz)
        for place, rms in zip(places.tolist(), rms_nm.tolist(), strict=True)
    ]
    coefficients = np.array([model.coefficients for model in models])
    driving_nm = np.array([model.driving_rms_nm for model in models])
    return float(np.max(power_within_frames(coefficients, driving_nm, rate_hz)))


def _worst_of_line(
    loop: ClosedLoop, axes: list[int], line: Line, low_hz: float, high_hz: float
) -> float:
    """Return the worst variance of a line in its band, with its skirts outside [nm^2].

    Means over frames count, and the rms is theirs.
    """
    rejection, along = loop.rejection(), np.asarray(line.direction)[:, None]
    response = replace(
        rejection, B=rejection.B @ along, C=rejection.C[axes], D=(rejection.D @ along)[axes]
    )
    worst = (line.rms_nm * band_norm(response, low_hz, high_hz).upper) ** 2
    if not isinstance(line, Vibration):
        return worst
    rate = loop.hardware.frame_rate_hz
    size = {"rms_nm": line.rms_nm, "damping": line.damping}
    skirts = Skirts(low_hz=low_hz, high_hz=high_hz, frame_rate_hz=rate, **size)

    def density(f: FloatArray) -> FloatArray:
        power = np.sum(np.abs(response.frequency_response(f)[:, :, 0]) ** 2, axis=1)
        return np.asarray((skirts.psd(f) * power)[:, None, None])

    edges = np.concatenate([resonance_edges(loop), np.clip(skirts.breakpoints_hz, 0, rate / 2)])
    return worst + float(adaptive_integral(density, np.unique(edges))[0, 0])


def _close(
    hardware: LoopHardware, controller: Controller | HasController, gains: FloatArray
) -> ClosedLoop:
    """Close the loop with a gain for each measurement."""
    return close_loop(replace(hardware, sensor_matrix=gains[:, None] * hardware.sensor), controller)


def _independent_axes(loop: ClosedLoop) -> list[tuple[list[int], list[int]]]:
    """Return axes and measurements that no gain of others touches; all if one axis is touched."""
    modes, q = loop.hardware.modes, loop.hardware.n_measurements
    together = [(list(range(modes)), list(range(q)))]
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
    return [([i], [i]) for i in range(modes)]
