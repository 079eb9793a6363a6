"""In which range of a gain or a delay a loop is stable: one that stays, or a gain that moves.

Every matrix is affine in the gain. Where the change of a part has rank one, as the gain of a
measurement has, all crossings of the unit circle are found at once: ``A + d b c'`` has an
eigenvalue z where ``d T(z) = 1`` with ``T = c' (z I - A)^-1 b``, and T is real at the angles of the
eigenvalues of a symplectic pencil. Other parts, and delays, are followed in steps.

A gain that moves: at the gain c the measurement feeds back through the complementary sensitivity T.
A gain between ``c (1 - r)`` and ``c (1 + r)`` adds the feedback ``d(k) T`` with ``|d(k)| <= r``, so
the loop is stable, whatever d does, if it is stable at c and ``r ||T||_inf < 1``. By the bounded
real lemma one quadratic Lyapunov function then decreases at every gain of the interval; through one
measurement it exists for no wider interval (P. P. Khargonekar, I. R. Petersen, K. Zhou, IEEE Trans.
Autom. Control 35, 356 (1990), doi:10.1109/9.50357). The norm is bracketed by level sets.

A gain and a delay that are both wrong: with the mirror's response ``M_d`` at a delay d, a loop that
is stable at the gain 1 and the delay d is stable at g and ``d'`` while ``I + X`` does not vanish on
the unit circle, where X is ``z^-1 (g M_d' - M_d)`` times what commands answer to noise, as the
sensor sees it. It does not while the Hermitian part of X lies above -1. ``M_d'`` is piecewise
linear in ``d'``, so that a few loops stand for all of a box of gains and delays: X of any other is
an average of theirs.

A command v that is clipped at the stroke is applied as ``d(k) v`` with d(k) in ``[r, 1]``, while it
asks for at most ``1 / r`` strokes. What is clipped off comes back through the loop as ``v = T_w (1
- d) v``, and the loop stays stable, whatever d does, if the Hermitian part of ``T_w`` lies below
``1 / (1 - r)`` (the circle criterion: H. K. Khalil, Nonlinear Systems, 3rd ed., section 7.1; in
discrete time E. I. Jury, B. W. Lee, IEEE Trans. Autom. Control 9, 51 (1964)).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.polynomial.polynomial import polysub
from scipy.optimize.elementwise import find_root

from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.linear.controller import EstimatorForm, HasController, as_controller
from lbt_synth.linear.matrix_functions import component_labels
from lbt_synth.linear.norms import fold_angles, largest_real_part, popov_angles, square_parts
from lbt_synth.linear.state_space import schur_form, schur_response
from lbt_synth.loop.closed_loop import ClosedLoop, checked_loop_matrices, close_loop
from lbt_synth.loop.evaluator import close_loops, textbook_matrices
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import instant_mirror, tapped_mirror
from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, number

AffinePart: TypeAlias = tuple[FloatArray, FloatArray]  # A0 and A1 of ``A0[t] + g A1[t]``

_STEP = 1.01  # ratio of neighbouring gains in the search for the ends of the interval
_WIDEST = 1e4
_AT_ONCE = 32  # gains, whose loops are in memory together
_FINER = 8  # parts into which a step is divided, again and again
_ROUNDS = 13  # for a gain, to its rounding
_RANK = 1e-12  # of a change, a singular value over the largest that counts as zero
_REAL = 1e-9  # part of a response that counts as zero; angles [rad] as close are the same
_DIVISION = 64  # of delays in which the delay margin is sought
_DELAY_ROUNDS = 6
_LONGEST = 100  # delay up to which it is sought [frames]
# Largest norm that counts as below 1: a norm is accurate to 1e-7 with a pole at 1 - 1e-9, and a
# loop with a pole nearer to the unit circle does not count as stable.
CIRCLE_LIMIT = 1 - 1e-7
_WIDEST_MOVING = 100.0  # factor on the loop's gain beyond which no pyramid's optical gain lies
# a loop of another gain, over the one assumed, and delay [frames], and taps of
# ``z^-1 (M_d - g M_d')``, (t,)
LoopChange: TypeAlias = tuple[float, float, FloatArray]
FRAGILE_FRAMES = 0.1  # of delay: what a camera's clock or a busy computer adds
FRAGILE_DB = 2.0  # of the sensor gain: what the seeing changes within minutes
_MOST = 10.0  # times these errors: one frame, and a factor of 10
_HALVINGS = 12  # of a range: to 0.03 % of a frame, and to 0.1 % of an end of gains
_LEVEL = 1 - 1e-6  # of the real part, below which one is proved to stay


def parts_by_gain(
    hardware: LoopHardware, controller: Controller | HasController
) -> list[AffinePart]:
    """Return the parts of a loop, each phase of which is affine in the gain of the own sensor."""
    plain = as_controller(controller, any_period=bool(hardware.suite.sensors))
    A0, A1, *_ = checked_loop_matrices(hardware, plain)
    states = A0.shape[-1]
    return affine_parts(A0.reshape(-1, states, states), A1.reshape(-1, states, states))


def affine_parts(A0: FloatArray, A1: FloatArray) -> list[AffinePart]:
    """Split ``A0[t] + g A1[t]``, (N, n, n), into the different parts that act on themselves."""
    links = np.any((A0 != 0) | (A1 != 0), axis=0)
    label = component_labels(links, strong=True)
    parts = (np.ix_(range(len(A0)), label == i, label == i) for i in np.unique(label))
    return list(
        {(A0[own].tobytes(), A1[own].tobytes()): (A0[own], A1[own]) for own in parts}.values()
    )


def affine_radii(parts: list[AffinePart], gains: FloatArray) -> FloatArray:
    """Return the spectral radius at each gain (g,), of the transition over all phases."""
    factors = np.asarray(gains)[:, None, None]
    eigenvalues = []
    for start, slope in parts:
        whole = np.eye(start.shape[1])
        for A, B in zip(start, slope, strict=True):
            whole = (A + factors * B) @ whole
        eigenvalues.append(np.linalg.eigvals(whole))
    return np.asarray(np.max(np.abs(np.concatenate(eigenvalues, axis=1)), axis=1))


def stable_sensor_gains(
    hardware: LoopHardware, controller: Controller | HasController, *, nominal: float = 1.0
) -> tuple[float, float]:
    """Interval of sensor gains around a nominal one for which the loop is stable.

    Modes that do not mix have exact ends, from all gains at which a pole is on the unit circle.
    Where modes mix or other sensors are read, the spectral radius is followed in steps of 1 % from
    the nominal gain, and each end is refined by bisection.

    Parameters
    ----------
    hardware : LoopHardware
        Sensor, mirror and delay.
    controller : Controller or Design
        The controller, or a design that holds it.
    nominal : float, optional
        Gain inside the interval.

    Returns
    -------
    low, high : float
        Ends of the interval; 0 and inf when it reaches beyond a factor of 1e4.
        Both are ``nan`` when the loop is not stable at the nominal gain.

    Raises
    ------
    ProblemError
        If the nominal gain is not positive, or the sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=3, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> low, high = lbt.loop.stable_sensor_gains(path, lazy)
    >>> low, round(high, 6)  # 0.618034 / 0.5
    (0.0, 1.236068)
    """
    return stable_range(parts_by_gain(hardware, controller), number(nominal, "nominal", above=0))


def stable_range(parts: list[AffinePart], nominal: float) -> tuple[float, float]:
    """Return where all parts are stable: nan if nowhere, 0 and inf at open ends."""
    if not affine_radii(parts, np.array([nominal]))[0] < 1:
        return np.nan, np.nan
    ranges = np.array(
        [
            exact_range(part, nominal) or stepped_range(partial(affine_radii, [part]), nominal)
            for part in parts
        ]
    )
    low, high = float(ranges[:, 0].max()), float(ranges[:, 1].min())
    return low if low > nominal / _WIDEST else 0.0, high if high < nominal * _WIDEST else np.inf


def exact_range(part: AffinePart, nominal: float) -> tuple[float, float] | None:
    """Return where a part stays stable; None for a longer period or a higher rank."""
    start, slope = part
    if len(start) > 1:
        return None
    U, sizes, V = np.linalg.svd(slope[0])
    if np.any(sizes[1:] > _RANK * sizes[0]):
        return None
    if sizes[0] == 0:
        return -np.inf, np.inf
    b, c = U[:, :1] * sizes[0], V[:1]
    T = StateSpace(A=start[0] + nominal * slope[0], B=b, C=c, D=np.zeros((1, 1))).balanced()
    responses = crossings(T)[1].real
    changes = 1 / responses[responses != 0]
    below, above = changes[changes < 0], changes[changes > 0]
    return nominal + below.max(initial=-np.inf), nominal + above.min(initial=np.inf)


def crossings(T: StateSpace, *, real_part: float | None = None) -> tuple[FloatArray, ComplexArray]:
    """Return where a response from one input to one output is real on the unit circle, and it.

    With a real part, where it has that. The angles [rad] are within 0 and pi. Where it is real,
    ``T(z) = T(1/z)``; between the angles of the pencil the sign does not change.
    """
    Q, R, sign = np.zeros_like(T.A), np.zeros_like(T.D), -1.0
    if real_part is not None:
        R, sign = 2 * (T.D - real_part), 1.0
    angles = fold_angles(popov_angles(T.A, T.B, Q, T.C, R, sign=sign), 0.0, np.pi)
    form = schur_form(T)

    def response(at: FloatArray) -> ComplexArray:
        return np.asarray(schur_response(form, np.exp(1j * at))[:, 0, 0])

    def excess(at: FloatArray) -> FloatArray:
        there = response(at)
        return there.imag if real_part is None else there.real - real_part

    middle = (angles[1:] + angles[:-1]) / 2
    signs, zero = np.sign(excess(middle)), np.abs(excess(angles)) <= _REAL * abs(response(angles))
    (turns,) = np.nonzero((signs[1:] * signs[:-1] < 0) & ~zero[1:-1])  # of an inaccurate angle
    crossed = np.zeros(0)
    if turns.size:
        ends = middle[turns], middle[turns + 1]
        crossed = find_root(excess, ends, tolerances={"xatol": 1e-15, "xrtol": 0.0}).x
    places = np.sort(np.concatenate([angles[zero], crossed]))
    places = places[np.diff(places, prepend=-1.0) > _REAL]  # z and 1 / z differ by rounding
    return places, response(places)


def stepped_range(
    radii: Callable[[FloatArray], FloatArray], nominal: float = 1.0
) -> tuple[float, float]:
    """Return the interval around a stable gain in which radii (g,) of gains (g,) are below 1."""
    count = int(np.ceil(np.log(_WIDEST) / np.log(_STEP)))
    ends = []
    for ratio, open_end in ((1 / _STEP, 0.0), (_STEP, np.inf)):
        gains = np.asarray(nominal * ratio ** np.arange(count + 1), dtype=np.float64)
        steps = (gains[i : i + _AT_ONCE + 1] for i in range(0, count, _AT_ONCE))
        end = _last_stable(lambda g: radii(g) < 1, steps, rounds=_ROUNDS)
        ends.append(open_end if end is None else end)
    return ends[0], ends[1]


def _last_stable(
    are_stable: Callable[[FloatArray], BoolArray],
    steps: Iterable[FloatArray],
    *,
    rounds: int,
) -> float | None:
    """Return the last stable number before one that is not, None without; steps begin stable."""
    for numbers in steps:
        unstable = np.flatnonzero(~are_stable(numbers[1:]))
        for _ in range(rounds if unstable.size else 0):
            first, last = numbers[unstable[0]], numbers[unstable[0] + 1]
            numbers = np.linspace(first, last, _FINER + 1)
            unstable = np.append(np.flatnonzero(~are_stable(numbers[1:])), numbers.size - 2)
        if unstable.size:
            return float(numbers[unstable[0]])
    return None


def delay_margin_frames(loop: ClosedLoop, *, sign: int) -> float:
    """Least change of the delay at which the loop, as it is simulated, is unstable [frames].

    It is late with the sign 1, early with -1. A part of a frame is no phase lag: an exposure then
    sees two commands. So the poles of loops decide, whose delays differ by steps.
    """
    d = loop.hardware.delay_frames
    longest = _LONGEST - d if sign > 0 else d - 1
    if longest <= 0:
        return np.inf
    matrices = textbook_matrices([loop.controller])

    def are_stable(changes: FloatArray) -> BoolArray:
        gains = np.full(changes.size, loop.sensor_gain)
        return close_loops(matrices, loop.hardware, gains, d + sign * changes)[0]

    # at a whole delay, an exposure sees one command alone, and the loop gain has a peak
    peaks = np.asarray(sign * (np.arange(1, _LONGEST + 1) - d), dtype=np.float64)
    ends = np.unique(np.minimum([0.0, *2.0 ** np.arange(np.log2(_LONGEST) + 1)], longest))
    steps = (
        np.union1d(np.linspace(low, high, _DIVISION + 1), peaks[(peaks > low) & (peaks < high)])
        for low, high in pairwise(ends)
    )
    last = _last_stable(are_stable, steps, rounds=_DELAY_ROUNDS)
    return np.inf if last is None else last


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
    """Return ``r ||T||_inf`` of an interval of gains; inf if the middle is unstable."""
    middle = (low + high) / 2
    centred = close_loop(loop.hardware, loop.controller, sensor_gain=middle)
    if not centred.is_stable:
        return np.inf
    S = centred.path("noise", "reading")
    T = replace(S, D=S.D - np.eye(len(S.D)))  # its negative has the same norm
    return (high - low) / (2 * middle) * hinf_norm(T).upper


def moving_gain(loop: ClosedLoop) -> MovingGain:
    """Find the interval of a moving sensor gain in which a loop, stable at its own, is proved."""
    loop.require_stable()
    nominal = loop.sensor_gain
    constant = stable_sensor_gains(loop.hardware, loop.controller, nominal=nominal)
    ends = np.clip(constant, nominal / _WIDEST_MOVING, nominal * _WIDEST_MOVING)

    def interval(share: float) -> tuple[float, float]:
        low, high = nominal * (ends / nominal) ** share
        return float(low), float(high)

    def proves(share: float) -> bool:
        low, high = interval(share)
        return circle_norm(loop, low=low, high=high) < CIRCLE_LIMIT

    proved = _largest_proved(proves, 1.0)
    low, high = interval(proved) if proved else (np.nan, np.nan)
    return MovingGain(
        constant_low=constant[0],
        constant_high=constant[1],
        moving_low=low,
        moving_high=high,
    )


def stroke_ratio(
    hardware: LoopHardware,
    controller: Controller | HasController | EstimatorForm,
    *,
    sensor_gain: float = 1.0,
) -> float:
    """Return how many times the stroke commands may ask for, with a loop that is proved stable.

    The circle criterion proves no more, and says nothing of commands beyond.

    Parameters
    ----------
    hardware : LoopHardware
        Sensor, mirror and delay.
    controller : Controller, Design or EstimatorForm
        The plain form, which assumes that its commands are applied, or the one that is given those.
    sensor_gain : float, optional
        Real gain of the sensor relative to its matrix.

    Returns
    -------
    float
        The ratio, above 1; 1e4 where it is that or more.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable where nothing is clipped.
    ProblemError
        If the controller reads other sensors, or the sizes clash.

    Examples
    --------
    With a pole p, the loop of one frame ``x(k+1) = (p - g d(k)) x(k)`` needs ``d > (p - 1) / g``:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    >>> eager = lbt.Controller(A=1.1, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> round(lbt.loop.stroke_ratio(path, eager), 4)  # 0.5 / 0.1
    5.0
    """
    if isinstance(controller, EstimatorForm):
        plain, fed_back = controller.to_controller(), controller.applied
    else:
        plain = as_controller(controller)
        fed_back = np.zeros(plain.C.T.shape)
    loop = close_loop(hardware.own_sensor_alone(), plain, sensor_gain=sensor_gain)
    loop.require_stable()
    level = largest_real_part(_answer_to_clipping(loop, fed_back)) / CIRCLE_LIMIT
    return _WIDEST if level <= 1 else min(level / (level - 1), _WIDEST)


def _answer_to_clipping(loop: ClosedLoop, fed_back: FloatArray) -> StateSpace:
    """Return ``T_w``, from what is clipped off to commands, of which (n, m) are fed back."""
    k, hardware = loop.controller, loop.hardware
    mirror, influence = hardware.mirror_system.whole, hardware.influence
    A, C, (n, m) = loop.system.A, loop.path("noise", "command").C, influence.shape
    shown = np.zeros((len(A), m))  # what a unit of a command does to the mirror, and the residual
    shown[k.n_states : -n], shown[-n:] = mirror.repeated(m)[1], -mirror.D * influence
    state, answer = np.zeros((len(A), m)), k.C @ fed_back  # one frame later, where it is fed back
    state[: k.n_states] = fed_back
    A = np.block([[A, state + shown @ answer], [np.zeros((m, len(A) + m))]])
    B, C, D = -np.vstack([shown, np.eye(m)]), np.hstack([C, answer]), np.zeros((m, m))
    return StateSpace(A=A, B=B, C=C, D=D, dt_s=loop.system.dt_s)


def loop_changes(
    hardware: LoopHardware, *, low: float, high: float, delay_frames: float
) -> list[LoopChange]:
    """Return the loops that stand for all gains of an interval, and delays within an error."""
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
    commands, seen = loop.path("noise", "command"), loop.sensor_gain * hardware.sensor
    caused = seen @ hardware.influence  # what the sensor sees of the commands that noise causes
    parts = square_parts(replace(commands, C=caused @ commands.C, D=caused @ commands.D))

    def is_proved(scale: float) -> bool:
        factor, late = 10 ** (scale * FRAGILE_DB / 20), scale * FRAGILE_FRAMES
        changes = loop_changes(hardware, low=1 / factor, high=factor, delay_frames=late)
        systems = (append_taps(part, taps) for *_, taps in changes for part in parts)
        return all(largest_real_part(system, least=_LEVEL) < 1 for system in systems)

    return _largest_proved(is_proved, _MOST)


def _largest_proved(proves: Callable[[float], bool], most: float) -> float:
    """Return the largest number up to ``most`` that is proved, as all below it, by bisection."""
    if proves(most):
        return most
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if proves(middle) else (low, middle)
    return low
