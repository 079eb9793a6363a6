"""The identified model of a loop, with standard errors, and its tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lbt_synth.identification.fit.fitting import Search, required_evidence
from lbt_synth.identification.fit.order_search import excess_bands
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import BACKGROUND, CORNER, GAIN, SpectrumModel
from lbt_synth.identification.fit.whittle import (
    DIFFERENCE,
    FittedModel,
    density,
    derivatives,
    invert_information,
    minimise,
    part_densities,
)
from lbt_synth.models import (
    ARModel,
    LoopHardware,
    PositionLoop,
    TipTiltPlant,
    Truth,
    Vibration,
    tip_tilt_plant,
)
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING, coefficient_rows, drive_ratio
from lbt_synth.storage.display_unit import nm_text, shown_format, shown_unit
from lbt_synth.storage.rows import cell_text, column, fill_row, nm_column, row_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, frozen_copy

AXES = ("tip", "tilt")  # names of two axes
Kind = Literal["line", "broad", "turbulence"]
DIFFERENT = 3.0  # standard errors beyond which two values differ: chance 0.3 %
UNRESOLVED = 0.01  # half width times duration: narrower than that, a line looks like a sinusoid
_LEAST_NOISE = 0.01  # of the innovations: a filter for less trusts every measurement
_LEAST_PART = 1e-3  # of the noise: a component with less has no power
_FASTEST = 8.0  # nepers per frame: a pole that decays faster is gone after a frame


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifiedLine:
    """A resonance found in a spectrum, with standard errors."""

    # a narrow line; a resonance that is wide (damping ratio at least 0.1) or below the rest of the
    # spectrum; a part of the turbulence, which began below the lowest frequency of lines or stands
    # for a drift
    kind: Kind
    frequency_hz: float  # natural
    frequency_error_hz: float
    damping: float  # ratio; if not resolved, the largest that the record cannot tell from none
    damping_error: float
    resolved: bool  # whether the record is long enough to see its width
    rms_nm: float  # standard deviation of the displacement, wavefront
    rms_error_nm: float
    prominence: float  # density at its frequency over that of all the rest
    evidence: float  # what it adds to the logarithm of the likelihood
    # unit vector over the axes, the first number at least 0; None of an axis that has it for itself
    direction: tuple[float, ...] | None = None
    # of a line that both axes share; None of turbulence along the direction of the rms of the axes
    direction_error_deg: float | None = None
    # beyond which the density of turbulence falls by another f^(-5/3), as of frozen flow
    corner_hz: float | None = None
    corner_error_hz: float | None = None
    sections: int = 1  # resonances in series: more than one make a bump of steep flanks

    @property
    def direction_deg(self) -> float | None:
        """Its direction from tip towards tilt [degrees], from -90 to 90; None without one."""
        if self.direction is None:
            return None
        first, second = (*self.direction, 0.0)[:2]
        return float(np.degrees(np.arctan2(second, first)))

    def axis_text(self, names: Sequence[str]) -> str:
        """Return the axis along which it shakes, or its direction with the standard error."""
        if self.direction is None or np.count_nonzero(self.direction) == 1:
            return names[0 if self.direction is None else int(np.argmax(self.direction))]
        error = self.direction_error_deg
        return f"{self.direction_deg:.4g}{'' if error is None else f' +- {error:.1g}'} deg"

    def vibration(self) -> Vibration:
        """Return the resonance as a part of a plant, along its direction, or tip without one."""
        return Vibration(
            frequency_hz=self.frequency_hz,
            damping=self.damping,
            rms_nm=self.rms_nm,
            direction=self.direction or (1.0, 0.0),
            sections=self.sections,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whiteness:
    """Test of the innovations, whose spectrum is the ratio of periodogram to model.

    Their cumulative periodogram is tested by Kolmogorov's distribution (M. S. Bartlett, An
    Introduction to Stochastic Processes, 1955).
    """

    cumulative: FloatArray  # (f,), from 0 to 1
    deviation: float  # largest distance of the cumulative periodogram from the diagonal
    effective: float  # number of independent values
    p_value: float  # probability of a larger distance if the innovations were white

    @property
    def white(self) -> bool:
        """Whether the test does not refuse whiteness at 1 %."""
        return self.p_value > 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdentifiedAxis(Summarised):
    """One axis: turbulence, lines, noise and sensor gain, with standard errors."""

    turbulence: ARModel  # a process of order 2 or 3
    turbulence_fit: IdentifiedLine  # its parameters; above a damping ratio of 1 with two real poles
    # all other resonances, by frequency; with a direction, this axis's share of one of both axes
    parts: tuple[IdentifiedLine, ...]
    # per frame on y, at least a hundredth of the innovations' deviation
    noise_nm: float
    noise_error_nm: float
    # of the noise of neighbouring frames, a first-order process: 0 where the data do not ask for
    # it, and the error says what they would have shown; plants take white noise of the same rms
    noise_correlation: float
    noise_correlation_error: float
    sensor_gain: float  # found or given
    sensor_gain_error: float | None  # None if it was given, or has no meaning
    sensor_gain_note: str  # where it comes from, and how well it is known
    # log-likelihood beyond the price by which the model is above one with a component less, at most
    # (the others are not fitted again; infinite without one), and above one with one more, about
    # (what bands of frequencies lack)
    over_fewer: float
    over_more: float
    whiteness: Whiteness  # of the innovations
    # one-sided densities [nm^2/Hz] of the pseudo-open-loop measurement, (f,) each: periodogram,
    # model, and model without its narrow lines
    frequency_hz: FloatArray
    density_nm2_hz: FloatArray
    fitted_nm2_hz: FloatArray
    background_nm2_hz: FloatArray
    fitted_model: FittedModel  # to start another fit from
    data: LoopPeriodogram  # what was fitted

    def _brief(self) -> str:
        lines = count_text(len(self.lines), "line")
        return f"{nm_text(self.rms_nm)} rms, {lines}, noise {nm_text(self.noise_nm)}"

    @property
    def lines(self) -> tuple[IdentifiedLine, ...]:
        """The narrow lines."""
        return tuple(part for part in self.parts if part.kind == "line")

    @property
    def rms_nm(self) -> float:
        """Deviation of the whole disturbance [nm]."""
        return float(np.linalg.norm([self.turbulence.rms_nm, *(p.rms_nm for p in self.parts)]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdentifiedModel(Summarised):
    """The axes of a loop as they were identified.

    Attributes
    ----------
    axes : tuple of IdentifiedAxis
        One per axis: tip, or tip and tilt.
    shared : tuple of IdentifiedLine
        Resonances that shake both axes along a direction, by frequency.
    frame_rate_hz : float
        Frame rate [Hz].
    delay_frames : float
        Total delay of the loop [frames].
    mirror : PositionLoop or None
        Dynamics of the mirror.
    notes : tuple of str
        Warnings and decisions that the user should know.
    """

    axes: tuple[IdentifiedAxis, ...]
    shared: tuple[IdentifiedLine, ...] = ()
    frame_rate_hz: float
    delay_frames: float
    mirror: PositionLoop | None = None
    notes: tuple[str, ...] = ()

    def _brief(self) -> str:
        return f"{self.hardware._brief()}, {count_text(len(self.parts), 'resonance')}"

    def _summarise(self) -> Summary:
        """Return turbulence, noise, sensor and vibrations."""
        return Summary(tables=model_tables(self), notes=self.notes)

    @property
    def sensor_gains(self) -> tuple[float, ...]:
        """Sensor gain of each axis."""
        return tuple(axis.sensor_gain for axis in self.axes)

    @property
    def hardware(self) -> LoopHardware:
        """The loop, with the sensor gains in its sensor matrix."""
        return LoopHardware(
            frame_rate_hz=self.frame_rate_hz,
            delay_frames=self.delay_frames,
            sensor_matrix=np.diag(self.sensor_gains),
            mirror=self.mirror,
        )

    @property
    def parts(self) -> tuple[IdentifiedLine, ...]:
        """All resonances, each once and with its direction: those of each axis, then the shared."""
        directions = np.eye(len(self.axes)).tolist()
        alone = [
            replace(line, direction=tuple(direction))
            for direction, axis in zip(directions, self.axes, strict=True)
            for line in axis.parts
            if line.direction is None
        ]
        return (*alone, *self.shared)

    def plant(self) -> TipTiltPlant:
        """Return the plant of a design: independent processes, those of both axes once."""
        return tip_tilt_plant(
            frame_rate_hz=self.frame_rate_hz,
            delay_frames=self.delay_frames,
            turbulence=[axis.turbulence for axis in self.axes],
            vibrations=[part.vibration() for part in self.parts],
            noise_nm=np.diag([axis.noise_nm**2 for axis in self.axes]),
            sensor_matrix=np.diag(self.sensor_gains),
            mirror=self.mirror,
        )

    def separated(self) -> IdentifiedModel:
        """Return the model in which each shared line is one line of each axis, independent."""
        axes = []
        for axis in self.axes:
            parts = (replace(x, direction=None, direction_error_deg=None) for x in axis.parts)
            axes.append(replace(axis, parts=tuple(parts)))
        return replace(self, axes=tuple(axes), shared=())

    def truth(self) -> Truth:
        """Return the same as the truth of an analysis, for :attr:`hardware`."""
        return Truth(
            turbulence=tuple(axis.turbulence for axis in self.axes),
            vibrations=tuple(part.vibration() for part in self.parts),
            noise_nm=np.array([axis.noise_nm for axis in self.axes]),
        )


def say_count(model: IdentifiedModel) -> str:
    """Say how well the record tells the number of components, on the axis that tells it least."""
    count = len(model.parts)
    over = [(axis.over_fewer, axis.over_more) for axis in model.axes]
    fewer, more = (min(values) for values in zip(*over, strict=True))
    told = f"from {count - 1} by at most {fewer:.0f} and " * bool(count)
    return (
        f"The record tells {count_text(count, 'component')} {told}from {count + 1} by about "
        f"{more:.0f} units of the log-likelihood beyond the price."
    )


def hold_gain(
    search: Search, model: FittedModel, errors: Sequence[tuple[Sequence[int], float]]
) -> FittedModel:
    """Return a fit whose gains have errors, and all that these move.

    The errors are relative ones, each common to the gains of some axes.
    """
    data, theta = search.merge(model.spectrum), model.spectrum.pack()
    gains = BACKGROUND * np.arange(len(model.spectrum.axes)) + GAIN
    information = model.information.copy()
    information[gains] = information[:, gains] = 0  # as if it were fitted at these gains
    held = covariance = invert_information(information)
    gradient = derivatives(data, model.spectrum)[1]
    for axes, error in errors:
        step = np.zeros_like(theta)
        step[gains[list(axes)]] = DIFFERENCE
        moved = derivatives(data, model.spectrum.unpack(theta + step))[1]
        moves = (step - held @ (moved - gradient)) / DIFFERENCE
        covariance = covariance + error**2 * np.outer(moves, moves)
    return replace(model, information=invert_information(covariance))


def _colour_error(search: Search, model: FittedModel) -> float:
    """Return the standard error that the colour of white noise would have if it were fitted."""
    spectrum = model.spectrum
    information = derivatives(search.merge(spectrum), spectrum)[2]
    priors = search.priors(spectrum.with_background(colour=1.0))
    fixed = np.setdiff1d(np.arange(priors.width.size), priors.free)
    information[fixed] = information[:, fixed] = 0
    information[priors.free, priors.free] += 1 / priors.width[priors.free] ** 2
    return replace(model, information=information).errors.background.colour


def describe_axis(
    search: Search,
    model: FittedModel,
    gain_error: float | None,
    note: str,
    *,
    colour_error: float = 0.0,
    directions: Sequence[tuple[tuple[float, float], float | None]] = (),
) -> IdentifiedAxis:
    """Return a fitted model in the units of the phase.

    ``gain_error`` is the standard error of the logarithm of the gain, None where it is given;
    ``colour_error`` by how much the noise's correlation differs in models that are as likely;
    ``directions`` those of the last components, which another axis has, too, and their errors.
    """
    data, spectrum = search.data, model.spectrum
    background, rate = spectrum.background, data.frame_rate_hz
    gain, errors = background.gain, model.errors.background
    densities = part_densities(data, spectrum)
    fitted = density(data, spectrum)
    first, *resonances = [
        _describe_line(search, model, i, part, fitted) for i, part in enumerate(densities)
    ]
    for i, (direction, error) in enumerate(directions, start=len(resonances) - len(directions)):
        resonances[i] = replace(resonances[i], direction=direction, direction_error_deg=error)
    smooth = fitted.copy()
    for resonance, line in zip(resonances, densities[1:], strict=True):
        if resonance.kind == "line":
            smooth -= line
    innovation = float(np.exp(0.5 * np.mean(np.log(fitted * rate / 2))))
    noise = max(float(np.exp(background.log_noise / 2)), _LEAST_NOISE * innovation)
    correlation = float(np.tanh(background.colour))
    colour = errors.colour if background.colour else _colour_error(search, model)
    parts = [resonance for resonance in resonances if resonance.rms_nm * gain > _LEAST_PART * noise]
    corner = float(np.exp(background.log_corner)) / data.angle_s
    turbulence = _turbulence_process(_nearest_process(search, spectrum), rate)
    slow = replace(
        first,
        kind="turbulence",
        rms_nm=turbulence.rms_nm,
        rms_error_nm=turbulence.rms_nm * first.rms_error_nm / first.rms_nm,
        corner_hz=corner if background.rolls_off else None,
        corner_error_hz=corner * errors.log_corner if background.rolls_off else None,
    )
    required = (required_evidence(search, spectrum, i) for i in range(len(model.evidence)))
    worth = [one - price for one, price in zip(model.evidence, required, strict=True)]
    lacking = excess_bands(data, data.power(gain) / fitted, least=0.0, most=1)
    return IdentifiedAxis(
        over_fewer=min(worth[1:], default=np.inf),
        over_more=max(search.price - max((band[0] for band in lacking), default=0.0), 0.0),
        turbulence=turbulence,
        turbulence_fit=slow,
        parts=tuple(sorted(parts, key=lambda part: part.frequency_hz)),
        noise_nm=noise,
        noise_error_nm=min(noise * errors.log_noise / 2, innovation),
        noise_correlation=correlation,
        noise_correlation_error=max(colour_error, (1 - correlation**2) * colour),
        sensor_gain=gain,
        sensor_gain_error=None if gain_error is None else gain * gain_error,
        sensor_gain_note=note,
        whiteness=whiteness(data, data.power(gain), fitted),
        frequency_hz=data.frequency_hz,
        density_nm2_hz=frozen_copy(data.power(gain) / gain**2),
        fitted_nm2_hz=frozen_copy(fitted / gain**2),
        background_nm2_hz=frozen_copy(smooth / gain**2),
        fitted_model=model,
        data=data,
    )


def _describe_line(
    search: Search, model: FittedModel, i: int, density: FloatArray, fitted: FloatArray
) -> IdentifiedLine:
    """Return the resonance of component i, given its density and that of all, (f,) each."""
    data, spectrum = search.data, model.spectrum
    line, error = spectrum.components[i], model.errors.components[i]
    natural, damping = _without_fast_pole(line.frequency, line.damping_ratio)
    frequency = natural / data.angle_s
    damping_error = damping * line.damping_slope * error.damping
    finest = 0.0 if data.duration_s is None else UNRESOLVED / data.duration_s / frequency
    resolved = damping >= finest
    if not resolved:
        damping = damping_error = finest
    rms = float(np.exp(line.log_power / 2)) / spectrum.background.gain
    by_gain = spectrum.unpack(model.covariance[GAIN])  # covariances with the gain
    variance = by_gain.background.log_gain - by_gain.components[i].log_power
    variance += error.log_power**2 / 4
    height = float(np.interp(frequency, data.frequency_hz, density))
    rest = float(np.interp(frequency, data.frequency_hz, fitted - density))
    narrow = line.sections == 1 and damping < WIDE_DAMPING and height > rest
    slow = line.kind != "line" or frequency < search.lowest_line_hz
    kind: Kind = "turbulence" if slow else "line" if narrow else "broad"
    return IdentifiedLine(
        kind=kind,
        frequency_hz=frequency,
        frequency_error_hz=frequency * error.log_frequency,
        damping=damping,
        damping_error=damping_error,
        resolved=resolved,
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(max(variance, 0.0))),
        prominence=height / rest if rest > 0 else float("inf"),
        evidence=model.evidence[i],
        sections=line.sections,
    )


def _without_fast_pole(frequency: float, damping: float) -> tuple[float, float]:
    """Return frequency and damping ratio with the faster of two real poles where it still shows."""
    if damping <= 1:
        return frequency, damping
    # nearly the same spectrum, but no coefficient of 1e-100
    root = float(np.sqrt(damping**2 - 1))
    slow, fast = frequency / (damping + root), min(frequency * (damping + root), _FASTEST)
    natural = float(np.sqrt(slow * fast))
    return natural, (slow + fast) / (2 * natural)


def _nearest_process(search: Search, spectrum: SpectrumModel) -> SpectrumModel:
    """Return the turbulence as the process of third order that is nearest by its likelihood."""
    if not spectrum.background.rolls_off:
        return spectrum
    alone = replace(spectrum, components=spectrum.components[:1])
    data = search.merge(alone)
    wide = (c for c in spectrum.components[1:] if not c.is_narrow)  # narrow ones do not matter
    held = density(data, spectrum.alone(*wide))
    seen, zero = density(data, alone) + held, np.zeros_like(held)
    fitted = replace(data, measured=seen, crossed=zero, corrected=zero)
    priors = search.priors(alone)
    width = priors.width.copy()
    width[:CORNER] = 0.0  # only the turbulence and its corner move
    start = replace(alone, roll_off_order=1.0)
    nearest = minimise(fitted, start, replace(priors, width=width), held=held)
    return start if nearest is None else nearest.spectrum


def _turbulence_process(spectrum: SpectrumModel, rate: float) -> ARModel:
    """Return the turbulence as a process of the phase, of order 2, or 3 with a roll-off."""
    slow, background = spectrum.components[0], spectrum.background
    place = _without_fast_pole(slow.frequency, slow.damping_ratio)
    (a1, a2), drive = coefficient_rows(*map(np.array, place)), drive_ratio(*place)
    polynomial = np.array([1.0, -a1, -a2])
    size = np.exp(slow.log_power / 2) / background.gain * np.sqrt(drive)
    if background.rolls_off:
        pole = np.exp(-np.exp(background.log_corner))
        polynomial = np.convolve(polynomial, [1.0, -pole])
        size *= 1 - pole
    return ARModel(coefficients=-polynomial[1:], driving_rms_nm=float(size), frame_rate_hz=rate)


def whiteness(data: LoopPeriodogram, power: FloatArray, model: FloatArray) -> Whiteness:
    """Test whether power and model (f,) differ as white innovations do."""
    from scipy.special import kolmogorov

    cumulative = np.cumsum(power / model)
    cumulative /= cumulative[-1]
    even = np.arange(1, cumulative.size + 1) / cumulative.size
    deviation, effective = float(np.max(np.abs(cumulative - even))), float(np.sum(data.count))
    return Whiteness(
        cumulative=frozen_copy(cumulative),
        deviation=deviation,
        effective=effective,
        p_value=float(kolmogorov(deviation * np.sqrt(effective))),
    )


@table_row
class VibrationRow:
    """A vibration on one axis, or along a direction over both."""

    axis: str = column("axis")  # or the direction
    frequency_hz: float = column("f", unit="Hz", format=".3f")
    frequency_error_hz: float = column("+-", unit="Hz", format=".2g")
    damping: str = column("damping")  # one that is not resolved has a bound, and no error
    damping_error: float | None = column("+-", format=".2g")
    rms_nm: float = nm_column("rms", format=".2f")
    rms_error_nm: float = column("+-", unit="nm", format=".2g")
    prominence: float = column("over the rest", format=".3g")
    origin: str = column("origin")


def model_tables(model: IdentifiedModel) -> list[Table]:
    """Return turbulence, noise and sensor of each axis, and the vibrations if there are any."""
    names = AXES if len(model.axes) == len(AXES) else ("-",)
    background = Table(
        caption="Turbulence, noise and sensor",
        headings=("quantity", "axis", "value", "error", "unit"),
        rows=tuple(
            (quantity, name, *cells)
            for name, axis in zip(names, model.axes, strict=True)
            for quantity, *cells in _background(axis)
        ),
        words=(4,),
    )
    lines = [
        fill_row(
            VibrationRow,
            line,
            axis=line.axis_text(names),
            damping=f"{line.damping:.3g}" if line.resolved else f"< {line.damping:.2g}",
            damping_error=line.damping_error if line.resolved else None,
            origin=line.kind + f", {line.sections} sections" * (line.sections > 1),
        )
        for line in model.parts
    ]
    return [background, *([row_table("Vibrations", lines)] if lines else [])]


def _background(axis: IdentifiedAxis) -> Iterator[tuple[str, ...]]:
    """Yield the cells of each quantity: its name, its value, its standard error and its unit."""
    slow, correlation = axis.turbulence_fit, axis.noise_correlation or None
    for quantity, value, digits, error, unit in (
        ("turbulence, rms", slow.rms_nm, ".1f", slow.rms_error_nm, "nm"),
        ("turbulence, frequency", slow.frequency_hz, ".4g", slow.frequency_error_hz, "Hz"),
        ("turbulence, damping", slow.damping, ".3g", slow.damping_error, ""),
        ("turbulence, roll-off", slow.corner_hz, ".3g", slow.corner_error_hz, "Hz"),
        ("noise per frame", axis.noise_nm, ".3f", axis.noise_error_nm, "nm"),
        ("noise, correlation", correlation, ".3f", axis.noise_correlation_error, ""),
        ("sensor gain", axis.sensor_gain, ".4f", axis.sensor_gain_error, ""),
    ):
        if value is not None:
            name, factor = shown_unit(unit)
            size = None if error is None else factor * error
            shown = cell_text(factor * value, shown_format(digits, factor))
            yield quantity, shown, cell_text(size, ".2g"), name
