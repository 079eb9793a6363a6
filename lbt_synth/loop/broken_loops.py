"""Responses of a loop that is broken at one measurement, and the points where margins are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import distinct_edges, gauss_panels, pole_edges
from lbt_synth.linear.state_space import split_into_parts
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.loop.stable_range import crossings
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
    gain_crossings: tuple[MarginPoint, ...]  # where the gain is one, with increasing frequency
    phase_crossings: tuple[MarginPoint, ...]  # where the phase is -180 degrees, likewise

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

    sensitivities = _own_sensitivities(loop)
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
            gain_crossings=tuple(_crossings(sensitivities[group[0]], real_part=0.5)),
            phase_crossings=tuple(
                point
                for point in _crossings(sensitivities[group[0]])
                if 1 / _LARGEST < -point.response.real < _LARGEST
            ),
        )
        for group in shared
    )


def gain_crossings(loop: ClosedLoop) -> list[MarginPoint]:
    """Return where the gain is one of a stable loop, broken at each measurement in turn."""
    sensitivities = _own_sensitivities(loop).values()
    return [point for own in sensitivities for point in _crossings(own, real_part=0.5)]


def _own_sensitivities(loop: ClosedLoop) -> dict[int, StateSpace]:
    """Return the sensitivity of each measurement to itself, balanced."""
    system = loop.output_sensitivity()
    system.require_one_phase("a broken loop", "output_sensitivity().lifted()")
    sensitivities = {}
    for outputs, inputs, part in split_into_parts(system):
        for measurement in np.intersect1d(outputs, inputs).tolist():
            i, j = (np.flatnonzero(channels == measurement) for channels in (outputs, inputs))
            own = replace(part, B=part.B[:, j], C=part.C[i], D=part.D[np.ix_(i, j)])
            sensitivities[measurement] = own.balanced()
    return sensitivities


def _crossings(sensitivity: StateSpace, *, real_part: float | None = None) -> Iterator[MarginPoint]:
    """Yield where the response of a broken loop is real, or where its gain is one.

    The gain of ``1 / S - 1`` is one where the real part of S is a half.
    """
    angles, values = crossings(sensitivity, real_part=real_part)
    with np.errstate(divide="ignore", invalid="ignore"):  # that of an integrator is inf
        responses = 1 / values - 1
    frequency_hz = angles / (2 * np.pi) / sensitivity.dt_s
    for f, response in zip(frequency_hz.tolist(), responses.tolist(), strict=True):
        yield MarginPoint(frequency_hz=f, response=response)


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


def phase_margin_deg(loop: ClosedLoop) -> float:
    """Return the least phase margin of a stable loop [deg]; inf without a gain crossing."""
    return min((point.phase_deg for point in gain_crossings(loop)), default=np.inf)


def _is_same(own: ComplexArray, other: ComplexArray) -> bool:
    """Whether two responses are equal, by their sensitivities."""
    return bool(np.allclose(1 / (1 + own), 1 / (1 + other), rtol=_SAME, atol=_SAME))
