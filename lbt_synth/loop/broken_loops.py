"""Responses of a loop that is broken at one measurement, and the points where margins are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize.elementwise import find_root

from lbt_synth.linear.quadrature import distinct_edges, gauss_panels, pole_edges
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, read_only

_SAME = 1e-9  # difference of sensitivities of equal axes
_LARGEST = 1e6  # loop gain beyond which, and below its inverse, much is rounding
_UNIFORM = 512  # frequencies at equal steps, beside those around resonances
_TURN, _ROUNDS = 0.15, 6  # a response turns less from one frequency to the next [rad]; halvings


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginPoint:
    """A point of a broken loop from which a margin is read."""

    frequency_hz: float  # where it is [Hz]
    response: complex  # the broken loop there

    @property
    def phase_deg(self) -> float:
        """Further phase lag that takes this point to -1 [deg], where its gain is one."""
        return float(np.degrees(np.mod(np.angle(self.response) + np.pi, 2 * np.pi)))

    @property
    def gain(self) -> float:
        """Factor on the gain that takes this point to -1, where its phase is -180 degrees."""
        return 1 / abs(self.response)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BrokenLoop:
    """A loop broken at one measurement, the others closed: ``1 / S_ii - 1`` over frequency."""

    measurements: tuple[int, ...]  # the measurements, from 0, that have this response
    # (f,): frequencies up to half the frame rate [Hz], more of them around resonances
    frequency_hz: FloatArray
    response: ComplexArray  # (f,): the loop gain; the loop is critical where it is -1
    at: Callable[[FloatArray], ComplexArray]  # the same at other frequencies

    @property
    def gain_crossings(self) -> tuple[MarginPoint, ...]:
        """Where the gain is one, with increasing frequency."""
        return tuple(self._crossings(lambda response: np.abs(response) - 1, last=True))

    @property
    def phase_crossings(self) -> tuple[MarginPoint, ...]:
        """Where the phase is -180 degrees, with increasing frequency."""
        across = self._crossings(lambda response: response.imag, last=False)
        for end in (0.0, float(self.frequency_hz[-1])):  # where a response is real
            with np.errstate(divide="ignore", invalid="ignore"):  # that of an integrator's is inf
                response = complex(self.at(np.array([end]))[0]).real
            across.append(MarginPoint(frequency_hz=end, response=response))
        points = (p for p in across if 1 / _LARGEST < -p.response.real < _LARGEST)
        return tuple(sorted(points, key=lambda point: point.frequency_hz))

    def _crossings(
        self, value: Callable[[ComplexArray], FloatArray], *, last: bool
    ) -> list[MarginPoint]:
        """Refine where a value of the response changes its sign, at the last frequency or not."""
        grid, level = self.frequency_hz, value(self.response[: None if last else -1])
        (starts,) = np.nonzero(level[1:] * level[:-1] < 0)
        if not starts.size:
            return []
        ends = grid[starts], grid[starts + 1]

        def level_at(frequency_hz: FloatArray) -> FloatArray:
            return value(self.at(frequency_hz))

        root = find_root(level_at, ends, tolerances={"xatol": 1e-12, "xrtol": 0.0})
        sizes = [np.abs(level_at(end)) for end in ends]
        nearer = np.where(sizes[0] <= sizes[1], *ends)  # where only rounding had changed the sign
        frequency_hz = np.where(root.success, root.x, nearer)
        pairs = zip(frequency_hz.tolist(), self.at(frequency_hz).tolist(), strict=True)
        return [MarginPoint(frequency_hz=f, response=response) for f, response in pairs]

    @property
    def gain_db(self) -> FloatArray:
        """Gain [dB], (f,)."""
        return frozen_copy(20 * np.log10(np.maximum(np.abs(self.response), 1e-300)))

    @property
    def phase_deg(self) -> FloatArray:
        """Phase without jumps [deg], (f,); between -270 and 90 at the lowest frequency.

        It is nan where the response is zero but for rounding, as at half the frame rate for a
        delay of half a frame.
        """
        phase = np.full(self.response.size, np.nan)
        known = np.abs(self.response) > 1 / _LARGEST
        unwrapped = np.degrees(np.unwrap(np.angle(self.response[known])))
        phase[known] = unwrapped - 360 * np.ceil((unwrapped[:1] - 90) / 360)
        return frozen_copy(phase)

    @property
    def phase_margin(self) -> MarginPoint | None:
        """The gain crossing with the least phase margin; None without a crossing."""
        return min(self.gain_crossings, key=lambda point: point.phase_deg, default=None)

    @property
    def gain_margins(self) -> tuple[MarginPoint, ...]:
        """The phase crossings from which a rise and a fall of the gain reach -1 first."""
        crossings = self.phase_crossings
        rise = [point for point in crossings if point.gain > 1]
        fall = [point for point in crossings if point.gain < 1]
        return tuple(
            nearest(points, key=lambda point: point.gain)
            for nearest, points in ((max, fall), (min, rise))
            if points
        )


def broken_loops(loop: ClosedLoop) -> tuple[BrokenLoop, ...]:
    """Break a stable loop at each measurement in turn, the others closed.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.

    Returns
    -------
    tuple of BrokenLoop
        One for each response; measurements whose responses are equal share it.

    Raises
    ------
    UnstableLoopError
        If the loop is not stable.

    Examples
    --------
    An integrator of gain 0.5 in a two-frame loop has a phase margin of 90 - 3 asin(0.25) degrees:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> both = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    >>> (found,) = lbt.loop.broken_loops(both)
    >>> found.measurements, round(found.phase_margin.phase_deg, 2)
    ((0, 1), 46.57)
    """
    loop.require_stable()
    system, nyquist = loop.output_sensitivity(), loop.hardware.frame_rate_hz / 2
    poles = pole_edges(loop.controller.to_statespace().poles)  # resonances of the open loop
    edges = distinct_edges(np.concatenate([resonance_edges(loop) / nyquist, poles[poles > 1e-6]]))
    nodes, _ = gauss_panels(edges * nyquist, 12)
    uniform = np.linspace(0, nyquist, _UNIFORM + 1)[1:]

    def broken(frequency_hz: FloatArray) -> ComplexArray:
        """Return the response of each broken loop, (f, q); with S, ``1 + l_i = 1 / S_ii``."""
        sensitivity = system.frequency_response(frequency_hz)
        return np.asarray(1 / np.diagonal(sensitivity, axis1=1, axis2=2) - 1)

    def broken_at(measurement: int, frequency_hz: FloatArray) -> ComplexArray:
        return broken(frequency_hz)[:, measurement]

    grid, responses = _refine_turns(broken, np.unique(np.concatenate([nodes, uniform])))
    shared: list[list[int]] = []
    for index, own in enumerate(responses.T):
        like = (group for group in shared if _is_same(own, responses[:, group[0]]))
        group = next(like, None)
        if group is None:
            shared.append([index])
        else:
            group.append(index)
    return tuple(
        BrokenLoop(
            measurements=tuple(group),
            frequency_hz=grid,
            response=read_only(responses[:, group[0]].copy()),
            at=partial(broken_at, group[0]),
        )
        for group in shared
    )


def _refine_turns(
    broken: Callable[[FloatArray], ComplexArray], grid: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Return a grid that is finer where responses turn, as beside their zeros, and them on it."""
    responses = broken(grid)
    for _ in range(_ROUNDS):
        turns = np.max(np.abs(np.angle(responses[1:] * responses[:-1].conj())), axis=1)
        (wide,) = np.nonzero(turns > _TURN)
        if not wide.size:
            break
        between = (grid[wide] + grid[wide + 1]) / 2
        responses = np.insert(responses, wide + 1, broken(between), axis=0)
        grid = np.insert(grid, wide + 1, between)
    return read_only(grid), responses


def phase_margin_deg(loops: tuple[BrokenLoop, ...]) -> float:
    """Return the least phase margin of broken loops [deg]; inf without a gain crossing."""
    points = (point for broken in loops for point in broken.gain_crossings)
    return min((point.phase_deg for point in points), default=np.inf)


def _is_same(own: ComplexArray, other: ComplexArray) -> bool:
    """Whether two responses are equal, by their sensitivities."""
    return bool(np.allclose(1 / (1 + own), 1 / (1 + other), rtol=_SAME, atol=_SAME))
