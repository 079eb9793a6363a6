"""The specification of one mode of the loop: one objective and any number of demands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.shaping.bounds import Attenuation, CommandRms
from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.demand_types import DEMANDS, Demand
from lbt_synth.design.shaping.frequency_grid import Grid, first_grid, thin_spectrum_edges
from lbt_synth.design.shaping.objectives import ResidualVariance, Term, leaves, require_term
from lbt_synth.design.shaping.single_mode_loop import SingleModeLoop
from lbt_synth.design.shaping.uncertainty import MirrorUncertainty, SensorGainRange
from lbt_synth.errors import ProblemError
from lbt_synth.linear.convex_functions import Constraint, Function
from lbt_synth.models import ARModel, Spectrum
from lbt_synth.validation import sequence


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Specification:
    """Objective and demands of one mode.

    Parameters
    ----------
    objective : ResidualVariance, VibrationBand, Total or Worst
        What is made least.
    demands : sequence of demands, optional
        What has to hold: ModulusMargin, NoisePeak, Attenuation, SensorGainRange, DelayError,
        MirrorUncertainty, CommandRms. Stability at every sensor gain that the objective or a
        demand names is added where no range covers it.

    Raises
    ------
    ProblemError
        If one of them is of another kind.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> spec = lbt.design.shaping.Specification(
    ...     objective=lbt.design.shaping.VibrationBand(
    ...         low_hz=16.5, high_hz=23.5, rms_nm=797, sensor_gain=0.5
    ...     ),
    ...     demands=[lbt.design.shaping.ModulusMargin(at_least=0.45)],
    ... )
    >>> [demand.label for demand in spec.demands][1]
    'stability for sensor gains 0.5 to 1'
    """

    objective: Term
    demands: tuple[Demand, ...] = ()

    def __post_init__(self) -> None:
        require_term(self.objective)
        demands: list[Any] = list(sequence(self.demands, "demands"))
        for demand in demands:
            if not isinstance(demand, DEMANDS):
                known = ", ".join(kind.__name__ for kind in DEMANDS)
                raise ProblemError(f"a demand must be one of {known}; got {type(demand).__name__}.")
        gains = [leaf.sensor_gain for leaf in leaves(self.objective)]
        gains += [d.sensor_gain for d in demands if isinstance(d, Attenuation)]
        low, high = min(1.0, *gains), max(1.0, *gains)
        ranges = [d for d in demands if isinstance(d, SensorGainRange)]
        if not any(r.low <= low and r.high >= high for r in ranges) and low < high:
            demands.append(SensorGainRange(low=low, high=high))
        object.__setattr__(self, "demands", tuple(demands))

    @property
    def bands_hz(self) -> tuple[tuple[float, float], ...]:
        """Bands of the objective and of the demands [Hz]."""
        masks = [d for d in self.demands if isinstance(d, Attenuation | MirrorUncertainty)]
        named = [*self.objective.bands_hz, *((d.low_hz, d.high_hz) for d in masks)]
        return tuple(dict.fromkeys(named))

    @property
    def spectra(self) -> tuple[Spectrum, ...]:
        """Spectra of the objective and of the demands."""
        named = [leaf for leaf in leaves(self.objective) if isinstance(leaf, ResidualVariance)]
        bounded = [demand for demand in self.demands if isinstance(demand, CommandRms)]
        found = [*(part.turbulence for part in named), *(part.turbulence for part in bounded)]
        return tuple(spectrum for spectrum in found if spectrum is not None)

    def require_fitting(self, frame_rate_hz: float) -> None:
        """Refuse bands beyond the Nyquist frequency, and models of another frame rate.

        Raises
        ------
        ProblemError
            Naming the band or the rate.
        """
        for low, high in self.bands_hz:
            if high > frame_rate_hz / 2:
                raise ProblemError(
                    f"a band must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; got "
                    f"{low:g} to {high:g} Hz."
                )
        for spectrum in self.spectra:
            if isinstance(spectrum, ARModel) and not np.isclose(
                spectrum.frame_rate_hz, frame_rate_hz, rtol=1e-9
            ):
                raise ProblemError(
                    f"an ARModel must be sampled at the loop's {frame_rate_hz:.6g} Hz; got "
                    f"{spectrum.frame_rate_hz:.6g} Hz."
                )

    def grid(self, channel: Channel, *, fineness: int = 1) -> Grid:
        """Return the first grid of frequencies for a channel."""
        nyquist = channel.nyquist_hz
        edges = [thin_spectrum_edges(spectrum, nyquist) for spectrum in self.spectra]
        return first_grid(
            channel.hardware.frame_rate_hz,
            bands_hz=self.bands_hz,
            poles=channel.basis.poles,
            breakpoints_hz=np.unique(np.concatenate([np.zeros(0), *edges])),
            fineness=fineness,
        )

    def compile(
        self, channel: Channel, grid: Grid
    ) -> tuple[Function, tuple[tuple[Constraint, ...], ...]]:
        """Return the objective, and the constraints of each demand, over a grid."""
        return self.objective.function(channel, grid), self.constraints(channel, grid)

    def constraints(self, channel: Channel, grid: Grid) -> tuple[tuple[Constraint, ...], ...]:
        """Return the constraints of each demand over a grid."""
        return tuple(demand.constraints(channel, grid) for demand in self.demands)

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check each demand on the real loop."""
        return tuple(check for demand in self.demands for check in demand.checks(loop))
