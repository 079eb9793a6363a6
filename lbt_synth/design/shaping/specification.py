"""The specification of one mode of the loop: one objective and any number of demands.

A gain file holds it as plain metadata. Other controllers are held against it, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np

from lbt_synth.design.certificate import Check
from lbt_synth.design.plain import to_plain
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop, held_fraction, mode_loop
from lbt_synth.design.shaping.demands import (
    Attenuation,
    CommandRms,
    Demand,
    LoopErrors,
    MovingSensorGain,
)
from lbt_synth.design.shaping.frequencies import Grid, distinct_bands, first_grid
from lbt_synth.design.shaping.objectives import (
    ResidualVariance,
    Term,
    VibrationBand,
    leaves,
    require_term,
    spectrum_of,
)
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.linear.convex_functions import Constraint, Function
from lbt_synth.linear.matrix_functions import component_labels
from lbt_synth.loop import least_residual
from lbt_synth.loop.band_limit import BandLimit, least_worst_residual
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.least_residual import (
    ResidualLimit,
    above_percent,
    limit_or_nan,
)
from lbt_synth.models import (
    ARModel,
    LoopHardware,
    Spectrum,
    Truth,
)
from lbt_synth.models.spectra import SumSpectrum
from lbt_synth.validation import BoolArray, FloatArray, sequence, set_fields

_ZERO = 1e-12  # of an entry, over the largest of its matrix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Specification:
    """Objective and demands of one mode.

    Parameters
    ----------
    objective : ResidualVariance, VibrationBand, Total or Worst
        What is made least.
    demands : sequence of demands, optional
        What has to hold: ModulusMargin, NoisePeak, Attenuation, LoopErrors, MovingSensorGain,
        MirrorUncertainty, CommandRms. Stability at every sensor gain that the objective or a demand
        names is added where none covers it, with the largest delay error that is demanded.

    Raises
    ------
    ProblemError
        If one of them is of another kind, or a demand is given twice.

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
            if not isinstance(demand, Demand):
                known = ", ".join(kind.__name__ for kind in get_args(Demand))
                raise ProblemError(f"a demand must be one of {known}; got {type(demand).__name__}.")
        written = [to_plain(demand) for demand in demands]
        for index, demand in enumerate(demands):
            if written[index] in written[:index]:
                raise ProblemError(f"each demand must be given once; got twice {demand.label!r}.")
        gains = [leaf.sensor_gain for leaf in leaves(self.objective)]
        gains += [d.sensor_gain for d in demands if isinstance(d, Attenuation)]
        low, high = min(1.0, *gains), max(1.0, *gains)
        ranges = [d for d in demands if isinstance(d, LoopErrors | MovingSensorGain)]
        if not any(r.low <= low and r.high >= high for r in ranges) and low < high:
            late = max((d.delay_frames for d in demands if isinstance(d, LoopErrors)), default=0.0)
            demands.append(LoopErrors(low=low, high=high, delay_frames=late))
        set_fields(self, demands=tuple(demands))

    @property
    def _parts(self) -> tuple[object, ...]:
        return (*leaves(self.objective), *self.demands)

    @property
    def key(self) -> str:
        """Text that equal specifications share."""
        return json.dumps(to_plain(self))

    @property
    def bands_hz(self) -> tuple[tuple[float, float], ...]:
        """Bands of the objective and of the demands [Hz]."""
        return distinct_bands(self._parts)

    def spectra(self, frame_rate_hz: float) -> tuple[Spectrum, ...]:
        """Return the spectra of the objective and of the demands."""
        found = [part.turbulence for part in self.demands if isinstance(part, CommandRms)]
        found += [spectrum_of(leaf, frame_rate_hz) for leaf in leaves(self.objective)]
        return tuple(spectrum for spectrum in found if spectrum is not None)

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
        """Return the objective, and the constraints of each demand, over a grid."""
        groups = tuple(demand.constraints(channel, grid) for demand in self.demands)
        return self.objective.function(channel, grid), groups

    def checks(self, loop: SingleModeLoop) -> tuple[Check, ...]:
        """Check each demand on the real loop."""
        return tuple(check for demand in self.demands for check in demand.checks(loop))


def violated_demands(
    specifications: Sequence[Specification], hardware: LoopHardware, controller: Controller
) -> tuple[str, ...] | None:
    """Return the demands on each mode that a controller violates; None if it couples the modes."""
    found: dict[str, None] = {}
    for mode, specification in enumerate(specifications):
        alone = _controller_of_mode(controller, hardware, mode)
        if alone is None:
            return None
        loop = SingleModeLoop(hardware=hardware.single_mode(), controller=alone)
        for demand in specification.demands:
            try:
                met = all(check.passed for check in demand.checks(loop))
            except UnstableLoopError:
                met = False
            if not met:
                found[demand.label] = None
    return tuple(found)


def _controller_of_mode(
    controller: Controller, hardware: LoopHardware, mode: int
) -> Controller | None:
    """Return the part of a controller that acts on a mode, None if it mixes modes."""
    A, B = controller.A, controller.B @ hardware.sensor
    C = hardware.influence @ controller.C
    D = hardware.influence @ controller.D @ hardware.sensor
    n, modes = len(A), len(D)
    whole = np.zeros((n + modes, n + modes), dtype=np.bool_)  # which state or mode acts on which
    whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:] = map(_entries, (A, B, C, D))
    label = component_labels(whole)
    if np.count_nonzero(label[n:] == label[n + mode]) > 1:
        return None
    own = label[:n] == label[n + mode]
    return Controller(
        A=A[np.ix_(own, own)],
        B=B[own, mode : mode + 1],
        C=C[mode : mode + 1, own],
        D=D[mode : mode + 1, mode : mode + 1],
        dt_s=controller.dt_s,
    )


def _entries(matrix: FloatArray) -> BoolArray:
    """Return where a matrix has an entry that is more than rounding."""
    size = np.abs(matrix)
    return np.asarray(size > _ZERO * np.max(size, initial=0.0))


def specified_limit(
    specifications: Sequence[Specification],
    hardware: LoopHardware,
    parameters: Sequence[Controller],
) -> tuple[float, float]:
    """Return the limit of the specified spectra [nm rms], and the residual above it [%].

    Both are over all modes at unit sensor gain: the variance plus the worst of the band. They
    are nan where a mode has no variance at unit gain, or several bands, as the limit of their
    sum is not known, and where a hold lies in two frames.
    """
    if held_fraction(hardware):
        return np.nan, np.nan
    limit_nm2, residual_nm2 = 0.0, 0.0
    for spec, parameter in zip(specifications, parameters, strict=True):
        at_unit = [leaf for leaf in leaves(spec.objective) if leaf.sensor_gain == 1]
        variances = [leaf for leaf in at_unit if isinstance(leaf, ResidualVariance)]
        bands = [leaf for leaf in at_unit if isinstance(leaf, VibrationBand)]
        if not variances or len(bands) > 1:
            return np.nan, np.nan
        spectra = [each.turbulence for each in variances if each.turbulence is not None]
        truth = Truth(
            turbulence=SumSpectrum(parts=tuple(spectra)) if spectra else None,
            noise_nm=float(np.linalg.norm([each.noise_nm for each in variances])),
        )
        found = limit_or_nan(partial(_mode_limit, hardware.single_mode(), truth, bands))
        loop = mode_loop(hardware, parameter)
        limit_nm2 += found**2
        residual_nm2 += sum(variance.measured_nm2(loop) for variance in variances)
        residual_nm2 += sum(band.measured_nm2(loop) for band in bands)
    limit_nm = float(np.sqrt(limit_nm2))
    return limit_nm, above_percent(float(np.sqrt(residual_nm2)), limit_nm)


def _mode_limit(
    hardware: LoopHardware, truth: Truth, bands: list[VibrationBand]
) -> ResidualLimit | BandLimit:
    if not bands:
        return least_residual(hardware, truth, frame_means=True)
    return least_worst_residual(
        hardware,
        truth,
        band_hz=(bands[0].low_hz, bands[0].high_hz),
        rms_nm=bands[0].rms_nm,
        direction=(1.0,),
        frame_means=True,
    )
