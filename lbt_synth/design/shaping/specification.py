"""The specification of one mode of the loop: terms that are minimised, and demands.

A gain file holds it as plain metadata. Other controllers are held against it, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.plain import to_plain
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop
from lbt_synth.design.shaping.demands import Bound, CommandRms, Demand, LoopErrors
from lbt_synth.design.shaping.frequencies import Grid, first_grid
from lbt_synth.design.shaping.terms import Term, VibrationBand, spectrum_of
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.linear.convex_functions import Constraint, Function
from lbt_synth.loop import close_loop
from lbt_synth.models import ARModel, LoopHardware, Spectrum
from lbt_synth.models.loop_hardware import require_loop_rate
from lbt_synth.validation import sequence, set_fields

_COUPLED = 1e-9  # residual of a mode for a unit of another, above which a controller couples them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Specification:
    """What is minimised and demanded of one mode.

    Parameters
    ----------
    terms : sequence of ResidualVariance or VibrationBand
        Variances whose sum is made least.
    demands : sequence of Bound, LoopErrors or CommandRms
        What has to hold. Stability at every sensor gain that a term or a demand names is added
        where none covers it, with the largest delay error that is demanded.

    Raises
    ------
    ProblemError
        If one of them is of another kind, there is no term, or a demand is given twice.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.design.shaping.VibrationBand(
    ...     low_hz=16.5, high_hz=23.5, rms_nm=797, sensor_gain=0.5
    ... )
    >>> margin = lbt.design.shaping.Bound(response="rejection", at_most=1 / 0.45)
    >>> spec = lbt.design.shaping.Specification(terms=[line], demands=[margin])
    >>> [demand.label for demand in spec.demands]
    ['modulus margin of at least 0.45', 'stability for sensor gains 0.5 to 1']
    """

    terms: tuple[Term, ...]
    demands: tuple[Demand, ...] = ()

    def __post_init__(self) -> None:
        terms, demands = (
            _of_kind(getattr(self, name), name, kinds)
            for name, kinds in (("terms", Term), ("demands", Demand))
        )
        if not terms:
            raise ProblemError("a specification needs at least one term; got none.")
        written = [to_plain(demand) for demand in demands]
        for index, demand in enumerate(demands):
            if written[index] in written[:index]:
                raise ProblemError(f"each demand must be given once; got twice {demand.label!r}.")
        gains = [term.sensor_gain for term in terms]
        gains += [d.sensor_gain for d in demands if isinstance(d, Bound)]
        low, high = min(1.0, *gains), max(1.0, *gains)
        ranges = [d for d in demands if isinstance(d, LoopErrors)]
        if not any(r.low <= low and r.high >= high for r in ranges) and low < high:
            late = max((d.delay_frames for d in ranges), default=0.0)
            demands += (LoopErrors(low=low, high=high, delay_frames=late),)
        set_fields(self, terms=terms, demands=demands)

    @property
    def key(self) -> str:
        """Text that equal specifications share."""
        return json.dumps(to_plain(self))

    @property
    def bands_hz(self) -> tuple[tuple[float, float], ...]:
        """Bands of the terms and of the demands [Hz]."""
        parts = (*self.terms, *self.demands)
        bands = [part for part in parts if isinstance(part, VibrationBand | Bound)]
        ends = [(band.low_hz, band.high_hz) for band in bands if band.high_hz is not None]
        return tuple(dict.fromkeys(ends))

    def spectra(self, frame_rate_hz: float) -> tuple[Spectrum, ...]:
        """Return the spectra of the terms and of the demands."""
        spectra = [part.turbulence for part in self.demands if isinstance(part, CommandRms)]
        spectra += [spectrum_of(term, frame_rate_hz) for term in self.terms]
        return tuple(spectrum for spectrum in spectra if spectrum is not None)

    def require_fitting(self, hardware: LoopHardware) -> None:
        """Refuse bands beyond the Nyquist frequency, and models of another frame rate."""
        nyquist = hardware.frame_rate_hz / 2
        for low, high in self.bands_hz:
            if high > nyquist:
                nearest = f"the Nyquist frequency {nyquist:.6g} Hz"
                raise ProblemError(f"a band must lie below {nearest}; got {low:g} to {high:g} Hz.")
        for spectrum in self.spectra(hardware.frame_rate_hz):
            if isinstance(spectrum, ARModel):
                require_loop_rate(spectrum.frame_rate_hz, hardware)

    def grid(self, channel: Channel, *, fineness: int = 1) -> Grid:
        """Return the first grid of frequencies for a channel."""
        return first_grid(channel, self.bands_hz, self.spectra(2 * channel.nyquist_hz), fineness)

    def compile(
        self, channel: Channel, grid: Grid
    ) -> tuple[Function, tuple[tuple[Constraint, ...], ...]]:
        """Return the sum of the terms, and the constraints of each demand, over a grid."""
        groups = tuple(demand.constraints(channel, grid) for demand in self.demands)
        return sum((term.function(channel, grid) for term in self.terms), ()), groups

    def measured_nm2(self, loop: SingleModeLoop) -> float:
        """Return the sum of the terms in the real loop."""
        return sum(term.measured_nm2(loop) for term in self.terms)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check each demand on the real loop."""
        return tuple(check for demand in self.demands for check in demand.checks(loop))


def _of_kind(values: Any, name: str, kinds: Any) -> tuple[Any, ...]:
    """Return terms or demands, each of a kind that there is."""
    listed: tuple[Any, ...] = tuple(sequence(values, name))
    for value in listed:
        if not isinstance(value, kinds):
            allowed = ", ".join(kind.__name__ for kind in get_args(kinds))
            raise ProblemError(f"{name} must be of {allowed}; got {type(value).__name__}.")
    return listed


def violated_demands(
    specifications: Sequence[Specification], hardware: LoopHardware, controller: Controller
) -> tuple[str, ...] | None:
    """Return the demands on each mode that a controller violates; None if it couples the modes."""
    f = np.linspace(0, 0.4, 5) * hardware.frame_rate_hz
    sensitivity = np.abs(close_loop(hardware, controller).sensitivity(f))
    if np.any(sensitivity[:, ~np.eye(hardware.modes, dtype=np.bool_)] > _COUPLED):
        return None
    violated: dict[str, None] = {}
    for mode, specification in enumerate(specifications):
        loop = SingleModeLoop(hardware=hardware, controller=controller, mode=mode)
        for demand in specification.demands:
            try:
                met = all(check.passed for check in demand.checks(loop))
            except UnstableLoopError:
                met = False
            if not met:
                violated[demand.label] = None
    return tuple(violated)
