"""Stability margins of a loop, and the broken loops from which they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lbt_synth.linear import StateSpace, hinf_norm
from lbt_synth.linear.norms import independent_parts
from lbt_synth.linear.quadrature import gauss_panels, graded_edges
from lbt_synth.linear.state_space import split_into_parts
from lbt_synth.loop.budget import resonance_edges
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.loop.stable_range import (
    FRAGILE_DB,
    FRAGILE_FRAMES,
    crossings,
    delay_margin_frames,
    errors_together,
    stable_sensor_gains,
)
from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, read_only, require_instance

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
        """Phase without jumps [deg], (f,), first in -270 to 90; nan where all is rounding."""
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
    """Break a stable loop at each measurement in turn, the others closed; equal ones share it."""
    loop.require_stable()
    system, nyquist = loop.path("noise", "reading"), loop.hardware.frame_rate_hz / 2
    panels = graded_edges(loop.controller.to_statespace().poles)  # resonances of the open loop
    edges = np.union1d(resonance_edges(loop), panels[panels > 1e-6] * nyquist)
    nodes, _ = gauss_panels(edges, 12)
    uniform = np.linspace(0, nyquist, _UNIFORM + 1)[1:]

    def broken(frequency_hz: FloatArray) -> ComplexArray:
        """Return the response of each broken loop, (f, q); with S, ``1 + l_i = 1 / S_ii``."""
        sensitivity = system.frequency_response(frequency_hz)
        return np.asarray(1 / np.diagonal(sensitivity, axis1=1, axis2=2) - 1)

    sensitivities = _own_sensitivities(loop)
    grid, responses = _refine_turns(broken, np.union1d(nodes, uniform))
    near = partial(np.allclose, rtol=_SAME, atol=_SAME)
    curves = 1 / (1 + responses.T)  # sensitivities, by which two loops are equal
    alike = [next(i for i, one in enumerate(curves) if near(one, curve)) for curve in curves]
    return tuple(
        BrokenLoop(
            measurements=tuple(i for i, first in enumerate(alike) if first == index),
            frequency_hz=grid,
            response=read_only(responses[:, index].copy()),
            gain_crossings=tuple(_crossings(sensitivities[index], real_part=0.5)),
            phase_crossings=tuple(
                point
                for point in _crossings(sensitivities[index])
                if 1 / _LARGEST < -point.response.real < _LARGEST
            ),
        )
        for index in sorted(set(alike))
    )


def gain_crossings(loop: ClosedLoop) -> list[MarginPoint]:
    """Return where the gain is one of a stable loop, broken at each measurement in turn."""
    sensitivities = _own_sensitivities(loop).values()
    return [point for own in sensitivities for point in _crossings(own, real_part=0.5)]


def _own_sensitivities(loop: ClosedLoop) -> dict[int, StateSpace]:
    """Return the sensitivity of each measurement to itself, balanced."""
    system = loop.path("noise", "reading")
    system.require_one_phase("a broken loop", "path('noise', 'reading').lifted()")
    sensitivities = {}
    for outputs, inputs, part in split_into_parts(system):
        for measurement in np.intersect1d(outputs, inputs).tolist():
            i, j = (np.flatnonzero(channels == measurement) for channels in (outputs, inputs))
            own = replace(part, B=part.B[:, j], C=part.C[i], D=part.D[np.ix_(i, j)])
            sensitivities[measurement] = own.balanced()
    return sensitivities


def _crossings(sensitivity: StateSpace, *, real_part: float | None = None) -> Iterator[MarginPoint]:
    """Yield where a broken loop is real, or has a gain of one: where Re S is a half."""
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


@table_row
class LoopMargins(Summarised):
    """Margins of a stable loop.

    For the phase each measurement is broken in turn, the others closed; gain and delay change in
    all of them at once. The disk margin is of all measurements at once, each with a gain and a
    phase of its own; where axes are coupled it is proved, but may not be the largest.
    """

    def _brief(self) -> str:
        return f"modulus {self.modulus:.3g}, phase {self.phase_deg:.3g} deg"

    def _summarise(self) -> Summary:
        return Summary(tables=[fact_table("Margins", self)])

    modulus: float = column(
        "modulus margin",
        help="Least distance of the loop from instability, ``1 / ||(I + loop)^-1||_inf``",
    )
    gain_low: float = column(
        "stable gain factors, from",
        help="Least factor on the sensor gain that keeps it stable",
    )
    gain_high: float = column(
        "stable gain factors, to",
        help="Largest factor on the sensor gain; inf at an open end",
    )
    phase_deg: float = column(
        "phase margin",
        unit="deg",
        help="Least phase lag that destabilises; inf without a crossover",
    )
    delay_frames: float = column(
        "delay margin",
        unit="frames",
        help="Least further delay that destabilises; inf if the longest delay is stable",
    )
    early_frames: float = column(
        "early delay margin",
        unit="frames",
        help="Least delay less that destabilises; inf if a delay of one frame is stable",
    )
    together: float = column(
        "of 0.1 frames and 2 dB together",
        help="How many times both errors at once, either way, are proved to leave the loop stable, "
        "at most 10; nan for a mirror with dynamics",
    )
    crossover_hz: float = column(
        "highest crossover",
        unit="Hz",
        help="Highest frequency at which a loop's gain crosses one; 0 without any",
    )
    disk: float = column(
        "disk margin, axis by axis",
        help="Size of symmetric disks of gains and phases that are proved to keep the loop stable",
    )
    disk_gain_low: float = column(
        "stable factors of each axis, from", help="Least factors, each axis with its own"
    )
    disk_gain_high: float = column(
        "stable factors of each axis, to", help="Largest factors, each axis with its own"
    )
    disk_phase_deg: float = column(
        "stable phase of each axis, up to", unit="deg", help="Each axis with its own"
    )

    dt_s: float = column(unit="s", help="Frame period of the loop")

    @property
    def gain_errors_db(self) -> tuple[float, float]:
        """How much less and how much more sensor gain the loop survives [dB]; inf for any."""
        with np.errstate(divide="ignore"):  # no gain is too low
            low_db, high_db = 20 * np.abs(np.log10([self.gain_low, self.gain_high]))
        return float(low_db), float(high_db)

    @property
    def survival(self) -> str:
        """Which errors the loop survives, each alone and together, in a sentence."""
        low_db, high_db = self.gain_errors_db
        alone = (
            f"survives {_size(self.delay_frames, 'frames')} more delay or "
            f"{_size(self.early_frames, 'frames')} less, {_size(high_db, 'dB')} more sensor gain "
            f"or {_size(low_db, 'dB')} less"
        )
        if np.isnan(self.together):
            return f"{alone}; at once is not known for a mirror with dynamics."
        frames, decibels = self.together * FRAGILE_FRAMES, self.together * FRAGILE_DB
        return f"{alone}; at once {frames:.2g} frames and {decibels:.2g} dB either way (proved)."

    @property
    def fragilities(self) -> tuple[str, ...]:
        """Sentences on a delay or a gain that is hardly off and makes the loop unstable."""
        texts = []
        for frames, word in ((self.delay_frames, "more"), (self.early_frames, "less")):
            if frames < FRAGILE_FRAMES:
                texts.append(
                    f"{frames:.2g} frames ({frames * 1e6 * self.dt_s:.2g} us) {word} delay make "
                    "this loop unstable; do not close it so: take another method, or robust with "
                    "delay_error_frames."
                )
        if (least := min(self.gain_errors_db)) < FRAGILE_DB:
            texts.append(f"a sensor gain that is off by {least:.2g} dB makes this loop unstable.")
        if not texts and self.together < 1:
            texts.append(
                f"{FRAGILE_FRAMES:g} frames of delay and {FRAGILE_DB:g} dB of sensor gain at once "
                "are more than this loop is proved to survive. robust demands both together."
            )
        return tuple(texts)


def _size(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}".strip() if np.isfinite(value) else "any"


def loop_margins(loop: ClosedLoop) -> LoopMargins:
    """Gain, phase, delay and modulus margin of a stable loop.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.

    Returns
    -------
    LoopMargins
        The margins at the loop's sensor gain.

    Raises
    ------
    UnstableLoopError
        If the loop is not stable.

    Examples
    --------
    An integrator of gain 0.5 in a two-frame loop is stable up to a gain of 1:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> margins = lbt.loop_margins(lbt.close_loop(path, lazy))
    >>> margins.gain_low, round(margins.gain_high, 6)
    (0.0, 2.0)
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    loop = loop.feedback()
    low, high = stable_sensor_gains(loop.hardware, loop.controller, nominal=loop.sensor_gain)
    crossings = gain_crossings(loop)
    delay, early = (delay_margin_frames(loop, sign=sign) for sign in (1, -1))
    disk = _disk_margin(loop)
    return LoopMargins(
        modulus=1 / float(hinf_norm(loop.path("noise", "reading"))),
        gain_low=low / loop.sensor_gain,
        gain_high=high / loop.sensor_gain,
        phase_deg=min((point.phase_deg for point in crossings), default=np.inf),
        delay_frames=delay,
        early_frames=early,
        together=errors_together(loop),
        crossover_hz=max((point.frequency_hz for point in crossings), default=0.0),
        dt_s=loop.hardware.dt_s,
        disk=disk,
        disk_gain_low=max(2 - disk, 0.0) / (2 + disk),
        disk_gain_high=(2 + disk) / (2 - disk) if disk < 2 else np.inf,
        disk_phase_deg=float(np.degrees(2 * np.arctan(disk / 2))),
    )


def _disk_margin(loop: ClosedLoop) -> float:
    """Return the symmetric disk margin of all measurements at once, proved by a small gain.

    Eq. 32 of P. Seiler, A. Packard, P. Gahinet, IEEE Control Syst. 40(5), 78 (2020),
    doi:10.1109/MCS.2020.3005277, with the norm of ``(S - T) / 2`` in place of its structured
    singular value, which for one measurement is the same.
    """
    S = loop.path("noise", "reading")
    centred = replace(S, D=S.D - np.eye(len(S.D)) / 2)
    parts = independent_parts(centred)  # each measurement is an input and an output of its part
    return 1 / max(hinf_norm(part).upper for part in parts)
