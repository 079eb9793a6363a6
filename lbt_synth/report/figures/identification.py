"""Figure of an identification: spectrum and fit, what adds up to the residual, innovations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification import IdentifiedAxis, IdentifiedLine, IdentifiedModel
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.report.charts.description import Area, Axis, Curve, Flags, Panel, Span
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray, require_instance

_BANDS = 240  # of equal ratio over which the periodogram is averaged
_KOLMOGOROV = 1.6276  # Kolmogorov's statistic at 1 %
_NAMES = ("tip", "tilt")


def identification_figure(
    model: IdentifiedModel,
    *,
    designs: Mapping[str, Controller | Design] | None = None,
    axes: OwnAxes = None,
) -> Figure:
    """Draw what was identified, one column per axis.

    Parameters
    ----------
    model : IdentifiedModel
        The model.
    designs : mapping of str to Controller or Design, optional
        Controllers whose predicted residual is drawn, by name.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Rows: density of the pseudo-open-loop measurement, with the fit, its background and the
        lines' frequencies and rms; rms accumulated from low to high frequencies, of the
        disturbance, of the measurement that ran (its noise included) and of what the designs
        would leave; cumulative periodogram of the innovations less that of white noise. Titles
        give the noise per frame and the sensor gain.

    Raises
    ------
    ProblemError
        If the model is none, or a design does not fit its loop,
        or ``axes`` are not one per panel.
    UnstableLoopError
        If the loop of a design is unstable.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> rng = np.random.default_rng(0)
    >>> record = lbt.identification.loop_record(
    ...     np.cumsum(rng.standard_normal((4096, 1)), axis=0), frame_rate_hz=500, unit="nm"
    ... )
    >>> len(lbt.report.figures.identification_figure(lbt.identify(record)).axes)
    3
    """
    require_instance(model, IdentifiedModel)
    panels = identification_panels(model, designs or {})
    return draw_figure(panels, columns=len(model.axes), axes=axes)


def identification_panels(
    model: IdentifiedModel, designs: Mapping[str, Controller | Design]
) -> list[Panel]:
    """Return the panels of the figure, row by row."""
    residuals = _predicted_residuals(model, designs)
    cumulative = [
        _cumulative_curves(axis, {name: densities[i] for name, densities in residuals.items()})
        for i, axis in enumerate(model.axes)
    ]
    last = [float(curve.y[-1]) for curves in cumulative for curve in curves if curve.y[-1] > 0]
    low, high = (0.2 * min(last), 1.5 * max(last)) if last else (None, None)
    rms = Axis(label="rms up to the frequency", unit="nm", log=True, low=low, high=high)
    density = _density_axis(model)
    rows = (
        [_spectrum_panel(model, i, density) for i in range(len(model.axes))],
        [
            Panel(x=_frequency(axis), y=rms, marks=tuple(curves), height_in=1.9)
            for axis, curves in zip(model.axes, cumulative, strict=True)
        ],
        [_innovations_panel(axis) for axis in model.axes],
    )
    return [panel for row in rows for panel in row]


def _predicted_residuals(
    model: IdentifiedModel, designs: Mapping[str, Controller | Design]
) -> dict[str, list[FloatArray]]:
    """Densities of the residual that each design would leave on each axis, (f,) each."""
    out: dict[str, list[FloatArray]] = {}
    for name, thing in designs.items():
        controller = thing.controller if isinstance(thing, Design) else thing
        if not isinstance(controller, Controller):
            raise ProblemError(
                f"designs must be Controllers or Designs; got {type(thing).__name__} for {name!r}."
            )
        loop = close_loop(model.hardware, controller)
        loop.require_stable()
        out[name], known = [], np.zeros(0)
        for i, axis in enumerate(model.axes):
            f = axis.frequency_hz
            if not np.array_equal(f, known):  # the axes of a record share their frequencies
                known = f
                reject, let_through = np.abs(loop.sensitivity(f)), np.abs(loop.noise_transfer(f))
            rejected, passed = reject[:, i] ** 2, let_through[:, i] ** 2
            density = np.zeros(f.size)
            for j, other in enumerate(model.axes):
                white = _noise_density(other)
                phase = np.interp(f, other.frequency_hz, other.fitted_nm2_hz) - white
                density += rejected[:, j] * phase
                density += passed[:, j] * white * other.sensor_gain**2
            out[name].append(density)
    return out


def _noise_density(axis: IdentifiedAxis) -> float:
    """Density of the noise, in units of the phase [nm^2/Hz]."""
    return 2 / axis.frame_rate_hz * (axis.noise_nm / axis.sensor_gain) ** 2


def _frequency(axis: IdentifiedAxis) -> Axis:
    first, last = float(axis.frequency_hz[0]), float(axis.frequency_hz[-1])
    return Axis(label="frequency", unit="Hz", log=True, low=first, high=last)


def _density_axis(model: IdentifiedModel) -> Axis:
    """Return the same scale for all axes, with room for the labels of lines."""
    smooth = [_average_bands(axis.frequency_hz, axis.density_nm2_hz)[1] for axis in model.axes]
    top = max(float(np.max(values)) for values in smooth)
    top = max([top, *(height for axis in model.axes for height in _line_heights(axis))])
    low = 0.2 * min(float(np.min(values)) for values in smooth)
    labelled = any(axis.lines for axis in model.axes)
    high = top * (top / low) ** (0.45 if labelled else 0.1)
    return Axis(label="density", unit="nm²/Hz", log=True, low=low, high=high)


def _line_heights(axis: IdentifiedAxis) -> FloatArray:
    peaks = [line.frequency_hz for line in axis.lines]
    return np.asarray(np.interp(peaks, axis.frequency_hz, axis.fitted_nm2_hz))


def _average_bands(
    f: FloatArray, density: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean frequency, mean, least and most of a density in bands of equal ratio."""
    edges = np.unique(np.searchsorted(f, np.geomspace(f[0], f[-1] * (1 + 1e-12), _BANDS)))
    edges = edges[edges < f.size]
    count = np.diff(np.append(edges, f.size))
    return (
        np.add.reduceat(f, edges) / count,
        np.add.reduceat(density, edges) / count,
        np.minimum.reduceat(density, edges),
        np.maximum.reduceat(density, edges),
    )


def _spectrum_panel(model: IdentifiedModel, i: int, density: Axis) -> Panel:
    axis = model.axes[i]
    f = axis.frequency_hz
    centres, smooth, least, most = _average_bands(f, axis.density_nm2_hz)
    name = f"{_NAMES[i]}: " if len(model.axes) == len(_NAMES) else ""
    gain = f"{axis.sensor_gain:.3g}"
    if axis.sensor_gain_error is not None:
        gain = f"{axis.sensor_gain:.3f} ± {axis.sensor_gain_error:.3f}"
    return Panel(
        title=f"{name}noise {nm_text(axis.noise_nm)}, gain {gain}",
        x=_frequency(axis),
        y=density,
        marks=(
            Area(name="periodogram: range", x=centres, low=least, high=most, look=None),
            Curve(name="periodogram: mean", x=centres, y=smooth, look=None, width=0.8),
            Curve(name="fit", x=f, y=axis.fitted_nm2_hz, look=0, width=1.3),
            Curve(name="fit without lines", x=f, y=axis.background_nm2_hz, look=1, width=1.2),
            Flags(
                x=np.array([line.frequency_hz for line in axis.lines]),
                y=_line_heights(axis),
                texts=tuple(_line_text(line) for line in axis.lines),
            ),
        ),
        height_in=3.0,
    )


def _line_text(line: IdentifiedLine) -> str:
    """Return frequency and rms of a line on its axis, and the direction if both axes share it."""
    along = "" if line.direction is None else f", {line.direction_deg:.0f}°"
    return f"{line.frequency_hz:.2f} Hz, {nm_text(line.rms_nm)}{along}"


def _cumulative_curves(axis: IdentifiedAxis, residuals: dict[str, FloatArray]) -> list[Curve]:
    """Return the rms that adds up from low to high frequencies."""
    f, white = axis.frequency_hz, _noise_density(axis)
    densities: list[tuple[str, FloatArray, int | None]] = [
        ("disturbance, data", axis.density_nm2_hz - white, None),
        ("disturbance, fit", axis.fitted_nm2_hz - white, 0),
    ]
    if axis.data.closed:
        densities.append(("measurement that ran", axis.data.measured / axis.sensor_gain**2, 2))
    densities += [
        (f"residual, {name}", density, look)
        for look, (name, density) in enumerate(residuals.items(), start=3)
    ]
    step = np.gradient(f)
    return [
        Curve(
            name=name,
            x=f,
            y=np.sqrt(np.maximum(np.cumsum(density * step), 0)),
            look=look,
            width=1.2,
        )
        for name, density, look in densities
    ]


def _innovations_panel(axis: IdentifiedAxis) -> Panel:
    test = axis.whiteness
    even = np.arange(1, test.cumulative.size + 1) / test.cumulative.size
    bound = 100 * _KOLMOGOROV / np.sqrt(test.effective)
    excess = 100 * (test.cumulative - even)
    reach = max(2 * bound, 1.2 * float(np.max(np.abs(excess))))
    return Panel(
        title="innovations, less white noise",
        x=_frequency(axis),
        y=Axis(label="power up to f", unit="%", low=-reach, high=reach),
        marks=(
            Span(name="99 % of white noise", axis="y", low=-bound, high=bound),
            Curve(name="", x=test.frequency_hz, y=excess, width=1.0),
        ),
        height_in=1.3,
    )
