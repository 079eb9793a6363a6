"""Figure of an identification: spectrum and fit, what adds up to the residual, innovations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification import IdentifiedAxis, IdentifiedModel
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.report.figures.style import house_style, new_figure, number_ticks
from lbt_synth.report.line_styles import COLOURS, LINES
from lbt_synth.validation import FloatArray, require_instance

_BANDS = 240  # of equal ratio over which the periodogram is averaged
_KOLMOGOROV = 1.6276  # Kolmogorov's statistic at 1 %
_NAMES = ("tip", "tilt")
_LABEL = 0.045  # width of a label, as a part of that of the plot
_FEW_DECADES = 40.0  # the ratio of the ends of an axis below which it has plain numbers
_FEW_CURVES = 2


def identification_figure(
    model: IdentifiedModel, *, designs: Mapping[str, Controller | Design] | None = None
) -> Any:
    """Draw what was identified, one column per axis.

    Parameters
    ----------
    model : IdentifiedModel
        The model.
    designs : mapping of str to Controller or Design, optional
        Controllers whose predicted residual is drawn, by name.

    Returns
    -------
    matplotlib.figure.Figure
        Rows: density of the pseudo-open-loop measurement, with the fit, its background and the
        lines' frequencies and rms; rms accumulated from low to high frequencies, of the
        disturbance, of the measurement that ran (its noise included) and of what the designs
        would leave; cumulative periodogram of the innovations less that of white noise.

    Raises
    ------
    ProblemError
        If the model is none, or a design does not fit its loop.
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
    residuals = _predicted_residuals(model, designs or {})
    columns = len(model.axes)
    with house_style():
        figure = new_figure(max(4.6, 4.1 * columns), 7.4)
        grid = figure.subplots(
            3, columns, squeeze=False, sharex="col", sharey="row", height_ratios=(5, 3, 2)
        )
        for i, axis in enumerate(model.axes):
            spectrum, cumulative, white = grid[:, i]
            _draw_spectrum(spectrum, axis, title=_panel_title(axis, i, columns))
            _draw_cumulative(cumulative, axis, {k: v[i] for k, v in residuals.items()})
            _draw_innovations(white, axis)
            white.set_xlabel("frequency [Hz]")
            if axis.frequency_hz[-1] / axis.frequency_hz[0] < _FEW_DECADES:
                number_ticks(white.xaxis)
        _set_spectrum_limits(grid[0, 0], model)
        grid[0, 0].set_ylabel("density [nm$^2$/Hz]")
        grid[1, 0].set_ylabel("rms up to the frequency [nm]")
        grid[2, 0].set_ylabel("innovations:\ncumulative\npower - white")
        grid[0, -1].legend(loc="lower left", fontsize=7)
        few = len(grid[1, -1].get_lines()) <= _FEW_CURVES
        grid[1, -1].legend(loc="lower right" if few else "upper left", ncols=2, fontsize=7)
        grid[2, -1].legend(loc="upper left", fontsize=7)
    return figure


def _panel_title(axis: IdentifiedAxis, i: int, columns: int) -> str:
    name = f"{_NAMES[i]}: " if columns == len(_NAMES) else ""
    noise = f"noise {axis.noise_nm:.3g} nm a frame"
    if axis.sensor_gain_error is None:
        return f"{name}{noise}, sensor gain {axis.sensor_gain:.3g}"
    return f"{name}{noise}, sensor gain {axis.sensor_gain:.3f} $\\pm$ {axis.sensor_gain_error:.3f}"


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
        found = []
        for i, axis in enumerate(model.axes):
            f = axis.frequency_hz
            rejected = np.abs(loop.sensitivity(f)[:, i]) ** 2
            passed = np.abs(loop.noise_transfer(f)[:, i]) ** 2
            density = np.zeros(f.size)
            for j, other in enumerate(model.axes):
                white = _noise_density(other)
                phase = np.interp(f, other.frequency_hz, other.fitted_nm2_hz) - white
                density += rejected[:, j] * phase
                density += passed[:, j] * white * other.sensor_gain**2
            found.append(density)
        out[name] = found
    return out


def _noise_density(axis: IdentifiedAxis) -> float:
    """Density of the noise, in units of the phase [nm^2/Hz]."""
    return 2 / axis.frame_rate_hz * (axis.noise_nm / axis.sensor_gain) ** 2


def _draw_spectrum(plot: Any, axis: IdentifiedAxis, *, title: str) -> None:
    f = axis.frequency_hz
    centres, smooth, least, most = _average_bands(f, axis.density_nm2_hz)
    plot.fill_between(centres, least, most, color="0.88", linewidth=0, label="periodogram: range")
    plot.loglog(centres, smooth, color="0.45", linewidth=1, label="periodogram: mean")
    plot.loglog(f, axis.fitted_nm2_hz, color=COLOURS[0], linewidth=1.3, label="fit")
    plot.loglog(
        f,
        axis.background_nm2_hz,
        color=COLOURS[1],
        linestyle="--",
        linewidth=1.2,
        label="fit without lines",
    )
    plot.set_xlim(f[0], f[-1])
    plot.set_title(title)
    span = float(np.log(f[-1] / f[0]))
    peaks = [line.frequency_hz for line in axis.lines]
    places = f[0] * np.exp(span * _spread_labels([float(np.log(x / f[0])) / span for x in peaks]))
    for line, place in zip(axis.lines, places, strict=True):
        height = float(np.interp(line.frequency_hz, f, axis.fitted_nm2_hz))
        plot.annotate(
            f"{line.frequency_hz:.2f} Hz, {line.rms_nm:.3g} nm",
            xy=(line.frequency_hz, height),
            xytext=(float(place), 0.985),
            textcoords=plot.get_xaxis_transform(),
            fontsize=6.5,
            rotation=90,
            ha="center",
            va="top",
            color="0.15",
            arrowprops={
                "arrowstyle": "-",
                "color": "0.6",
                "linewidth": 0.5,
                "relpos": (0.5, 0.0),
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )


def _spread_labels(places: Sequence[float]) -> FloatArray:
    """Return places in (0, 1) for labels near increasing ones, so that none overlap."""
    if not places:
        return np.zeros(0)
    gap = min(_LABEL, 1 / len(places))
    least = gap / 2 + gap * np.arange(len(places))
    steps = gap * np.arange(len(places))
    # pushed to the right where they are crowded, and back from the end
    right = np.maximum.accumulate(np.maximum(places, least) - steps) + steps
    ends = 1 - least[::-1]
    left = np.minimum.accumulate((np.minimum(right, ends) - steps)[::-1])[::-1] + steps
    return np.asarray(left)


def _set_spectrum_limits(plot: Any, model: IdentifiedModel) -> None:
    """Set the limits for all axes, with room for the labels of lines."""
    smooth = [_average_bands(axis.frequency_hz, axis.density_nm2_hz)[1] for axis in model.axes]
    top = max(float(np.max(values)) for values in smooth)
    for axis in model.axes:
        peaks = [line.frequency_hz for line in axis.lines]
        heights = np.interp(peaks, axis.frequency_hz, axis.fitted_nm2_hz) if peaks else [top]
        top = max(top, float(np.max(heights)))
    low = 0.2 * min(float(np.min(values)) for values in smooth)
    labelled = any(axis.lines for axis in model.axes)
    plot.set_ylim(low, top * (top / low) ** (0.45 if labelled else 0.1))


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


def _draw_cumulative(plot: Any, axis: IdentifiedAxis, residuals: dict[str, FloatArray]) -> None:
    f, white = axis.frequency_hz, _noise_density(axis)
    step = np.gradient(f)

    def rms(density: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(np.cumsum(density * step), 0)))

    curves = {
        "disturbance, data": rms(axis.density_nm2_hz - white),
        "disturbance, fit": rms(axis.fitted_nm2_hz - white),
    }
    if axis.data.closed:
        curves["measurement that ran"] = rms(axis.data.measured / axis.sensor_gain**2)
    for name, density in residuals.items():
        curves[f"residual, {name}"] = rms(density)
    greys = {"disturbance, data": "0.45"}
    for i, (name, values) in enumerate(curves.items()):
        colour = greys.get(name, COLOURS[(i - 1) % len(COLOURS)])
        plot.semilogx(
            f,
            values,
            color=colour,
            linestyle=LINES[max(i - 1, 0) % len(LINES)],
            label=name,
            linewidth=1.2,
        )
    plot.set_yscale("log")
    last = [float(values[-1]) for values in curves.values() if values[-1] > 0]
    if last:
        low, high = 0.2 * min(last), max(last)
        # room for the legend above many curves
        room = max(10.0, (high / low) ** 0.6) if len(curves) > _FEW_CURVES else 1.5
        plot.set_ylim(low, high * room)
        if high * room / low < _FEW_DECADES:
            number_ticks(plot.yaxis)


def _draw_innovations(plot: Any, axis: IdentifiedAxis) -> None:
    test = axis.whiteness
    even = np.arange(1, test.cumulative.size + 1) / test.cumulative.size
    bound = _KOLMOGOROV / np.sqrt(test.effective)
    plot.axhspan(-bound, bound, color="0.9", label="99 % of white noise")
    plot.plot(test.frequency_hz, test.cumulative - even, color=COLOURS[0], linewidth=1)
