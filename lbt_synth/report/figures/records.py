"""Figures of runs in time, and of the identification of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import kolmogi

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification import IdentifiedModel
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.linear import Controller
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.loop.budget import random_density
from lbt_synth.loop.simulation import Segment, Simulation
from lbt_synth.models import Truth, Vibration
from lbt_synth.models.vibration import checked_direction
from lbt_synth.report.draw import (
    PANEL_IN,
    SHADE,
    Figure,
    OwnAxes,
    colour,
    drawing,
    line_style,
    name_axes,
)
from lbt_synth.report.figures.loops import FREQUENCY
from lbt_synth.storage.display_unit import nm_text, shown_unit
from lbt_synth.validation import FloatArray, require_instance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIME = ("time", "s")
SERIES_S = 1.0  # of a series, in which single oscillations are seen
_WINDOW_S = 0.1  # over which the size of the residual is averaged
_BANDS = 240  # of equal ratio over which the periodogram is averaged
_FLAG_IN = 0.15  # width of an upright text
_NAMES = ("tip", "tilt")


def simulation_figure(
    run: Simulation,
    *,
    loop: ClosedLoop | None = None,
    truth: Truth | None = None,
    title: str = "",
) -> Figure:
    """Residual series of the first second of the first case, and spectra.

    The spectra, before the correction and after it, are means over all cases and sums over the
    axes; that of the transfer functions is beside them for a loop and a truth.
    """
    frames = min(run.residual_nm.shape[1], int(np.ceil(SERIES_S * run.frame_rate_hz)))
    with drawing([PANEL_IN, PANEL_IN], columns=2) as (series, spectra):
        _draw_series(series, run, frames, title)
        density = ("power spectrum", "nm²/Hz")
        _, factor = name_axes(spectra, FREQUENCY, density, xscale="log", yscale="log")
        f, opened, residual = run_spectra(run)
        before = line_style(None, linewidth=0.8)
        spectra.plot(f, factor * opened, label="before the correction", **before)
        spectra.plot(f, factor * residual, label="after it", **line_style(5, dash=0, linewidth=1.0))
        if loop is not None and truth is not None:
            exact = exact_spectrum(loop, truth, f, _segment(run))
            spectra.plot(f, factor * exact, label="after it, exact", **line_style(1))
        spectra.set_ylim(bottom=0.3 * factor * float(np.min(residual)))
    return series.figure


def _draw_series(axes: Axes, run: Simulation, frames: int, title: str) -> None:
    """Draw the residual of each axis in the first frames of the first case."""
    n = run.residual_nm.shape[2]
    names = _NAMES if n <= 2 else [f"mode {i}" for i in range(1, n + 1)]
    time = np.arange(frames) / run.frame_rate_hz
    _, factor = name_axes(axes, TIME, ("residual", "nm"), title)
    for i, name in zip(range(n), names, strict=False):
        values = factor * run.residual_nm[0, :frames, i]
        axes.plot(time, values, label=name, **line_style(i, dash=0, linewidth=0.7))


def sensor_failure_figure(
    run: Simulation, segments: Sequence[Segment], exact_nm: Sequence[float], *, title: str = ""
) -> Figure:
    """Residual of a run in which sensors fail: the series of its first case, and its size.

    The size is the mean over all cases. ``exact_nm`` is the stationary residual of each segment
    between failures and returns [nm rms], nan where there is none.
    """
    frames, window = run.residual_nm.shape[1], max(int(_WINDOW_S * run.frame_rate_hz), 1)
    end = frames // window * window
    power = np.mean(np.sum(run.image_nm2[:, :end], axis=2), axis=0)  # as the camera sees it
    rms_nm = np.sqrt(power.reshape(-1, window).mean(axis=1))
    centres = (np.arange(rms_nm.size) + 0.5) * window / run.frame_rate_hz
    failures = [segment for segment in segments if segment.text]
    looks = {text: 3 + i for i, text in enumerate(dict.fromkeys(s.text for s in failures))}
    with drawing([PANEL_IN, PANEL_IN]) as (series, size):
        _draw_series(series, run, frames, title)
        residual = ("residual, both axes", "nm rms")
        _, factor = name_axes(size, TIME, residual, yscale="log")
        last_s = frames / run.frame_rate_hz
        for panel in (series, size):
            for failure in failures:
                ends, shade = (failure.start_s, min(failure.end_s, last_s)), looks[failure.text]
                panel.axvspan(*ends, label=failure.text, color=colour(shade), **SHADE)
        label = f"in the run, over {_WINDOW_S:g} s"
        size.plot(centres, factor * rms_nm, label=label, **line_style(0))
        for segment, exact in zip(segments, exact_nm, strict=True):
            if np.isfinite(exact):
                ends = segment.start_s, min(segment.end_s, last_s)
                size.plot(ends, [factor * exact] * 2, label="exact", **line_style(2))
    return series.figure


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
        Your own matplotlib axes, one per panel; by default a new figure.

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
        If the model is none, a design does not fit its loop, or ``axes`` are not one per panel.
    UnstableLoopError
        If the loop of a design is unstable.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> drift = np.cumsum(np.random.default_rng(0).standard_normal((4096, 1)), axis=0)
    >>> record = lbt.identification.loop_record(drift, frame_rate_hz=500, unit="nm")
    >>> len(lbt.report.figures.identification_figure(lbt.identify(record)).axes)
    3
    """
    require_instance(model, IdentifiedModel)
    residuals = _predicted_residuals(model, designs or {})
    n = len(model.axes)
    heights = [height_in for height_in in (3.0, 1.9, 1.3) for _ in model.axes]
    with drawing(heights, columns=n, axes=axes) as panels:
        for i, axis in enumerate(model.axes):
            name = f"{_NAMES[i]}: " if n == len(_NAMES) else ""
            _draw_spectrum(panels[i], axis, name)
            densities = {name: each[i] for name, each in residuals.items()}
            _draw_cumulative(panels[n + i], axis, densities)
            _draw_innovations(panels[2 * n + i], axis)
        for row in (panels[:n], panels[n : 2 * n]):  # the same scale for all axes
            lows, highs = zip(*(panel.get_ylim() for panel in row), strict=True)
            for panel in row:
                panel.set_ylim(min(lows), max(highs))
        for panel, axis in zip(panels, model.axes, strict=False):
            _draw_flags(panel, axis)
    return panels[0].figure


def _predicted_residuals(
    model: IdentifiedModel, designs: Mapping[str, Controller | Design]
) -> dict[str, list[FloatArray]]:
    """Densities of the residual that each design would leave on each axis, (f,) each."""
    residuals: dict[str, list[FloatArray]] = {}
    for name, design in designs.items():
        controller = as_controller(design)
        if not isinstance(controller, Controller):
            raise ProblemError(
                f"designs must be Controllers or Designs; got {type(design).__name__} for {name!r}."
            )
        if isinstance(design, Design) and design.other_sensors:
            continue  # the model says nothing of what they read
        loop = close_loop(model.hardware, controller)
        loop.require_stable()
        residuals[name] = [_residual_density(model, loop, i) for i in range(len(model.axes))]
    return residuals


def _residual_density(model: IdentifiedModel, loop: ClosedLoop, i: int) -> FloatArray:
    """Density of the residual of an axis, of the phase and the noise of all axes, (f,)."""
    f = model.axes[i].frequency_hz
    rejected = np.abs(loop.sensitivity(f)[:, i]) ** 2
    passed = np.abs(loop.path("noise", "residual").frequency_response(f)[:, i]) ** 2
    density = np.zeros(f.size)
    for j, axis in enumerate(model.axes):
        white = _noise_density(axis)
        phase = np.interp(f, axis.frequency_hz, axis.fitted_nm2_hz) - white
        density += rejected[:, j] * phase + passed[:, j] * white * axis.sensor_gain**2
    return density


def _noise_density(axis: IdentifiedAxis) -> float:
    """Density of the noise, in units of the phase [nm^2/Hz]."""
    return 2 / axis.data.frame_rate_hz * (axis.noise_nm / axis.sensor_gain) ** 2


def _draw_spectrum(axes: Axes, axis: IdentifiedAxis, name: str) -> None:
    """Draw the periodogram with its fit, and leave room for the names of lines."""
    gain = f"{axis.sensor_gain:.3g}"
    if axis.sensor_gain_error is not None:
        gain = f"{axis.sensor_gain:.3f} ± {axis.sensor_gain_error:.3f}"
    title = f"{name}noise {nm_text(axis.noise_nm)}, gain {gain}"
    f, density = axis.frequency_hz, ("density", "nm²/Hz")
    _, factor = name_axes(axes, FREQUENCY, density, title, xscale="log", yscale="log")
    centres, smooth, least, most = _average_bands(f, axis.density_nm2_hz)
    band = {"label": "periodogram: range", "color": colour(None), **SHADE}
    axes.fill_between(centres, factor * least, factor * most, **band)
    mean = line_style(None, linewidth=0.8)
    axes.plot(centres, factor * smooth, label="periodogram: mean", **mean)
    axes.plot(f, factor * axis.fitted_nm2_hz, label="fit", **line_style(0))
    background = line_style(1, linewidth=1.2)
    axes.plot(f, factor * axis.background_nm2_hz, label="fit without lines", **background)
    top = factor * max(float(np.max(smooth)), *_line_heights(axis), 0.0)
    low = 0.2 * factor * float(np.min(smooth))
    axes.set_ylim(low, top * (top / low) ** (0.45 if axis.lines else 0.1))
    axes.set_xlim(f[0], f[-1])


def _line_heights(axis: IdentifiedAxis) -> FloatArray:
    peaks = [line.frequency_hz for line in axis.lines]
    return np.asarray(np.interp(peaks, axis.frequency_hz, axis.fitted_nm2_hz))


def _draw_flags(axes: Axes, axis: IdentifiedAxis) -> None:
    """Write the lines upright along the upper edge without overlaps, each tied to its point."""
    if not axis.lines:
        return
    factor = shown_unit("nm²/Hz")[1]
    x = [line.frequency_hz for line in axis.lines]
    y = factor * _line_heights(axis)
    points = axes.transData.transform(np.column_stack((x, y)))
    across = axes.transAxes.inverted().transform(points)[:, 0]
    width_in = axes.get_window_extent().width / axes.figure.dpi
    places = spread_labels(across, _FLAG_IN / width_in)
    tie = {"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "relpos": (0.5, 0.0)}
    for line, point, place in zip(axis.lines, zip(x, y, strict=True), places, strict=True):
        label = f"{line.frequency_hz:.2f} Hz, {nm_text(line.rms_nm)}"
        axes.annotate(
            label + ("" if line.direction is None else f", {line.direction_deg:.0f}°"),
            xy=point,
            xytext=(float(place), 0.985),
            textcoords="axes fraction",
            fontsize=6.5,
            rotation=90,
            ha="center",
            va="top",
            arrowprops={**tie, "shrinkA": 0, "shrinkB": 0},
        )


def spread_labels(places: FloatArray, width: float) -> FloatArray:
    """Return places in (0, 1) for labels of that width near increasing ones; none overlap."""
    gap = min(width, 1 / max(places.size, 1))
    steps = gap * np.arange(places.size)
    least = gap / 2 + steps
    # pushed to the right where they are crowded, and back from the end
    right = np.maximum.accumulate(np.maximum(places, least) - steps) + steps
    ends = 1 - least[::-1]
    return np.asarray(np.minimum.accumulate((np.minimum(right, ends) - steps)[::-1])[::-1] + steps)


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


def _draw_cumulative(axes: Axes, axis: IdentifiedAxis, residuals: dict[str, FloatArray]) -> None:
    """Draw the rms that adds up from low to high frequencies."""
    f, white = axis.frequency_hz, _noise_density(axis)
    densities: dict[str, tuple[FloatArray, int | None]] = {
        "disturbance, data": (axis.density_nm2_hz - white, None),
        "disturbance, fit": (axis.fitted_nm2_hz - white, 0),
    }
    if axis.data.closed:
        densities["measurement that ran"] = (axis.data.measured / axis.sensor_gain**2, 2)
    for look, (name, density) in enumerate(residuals.items(), start=3):
        densities[f"residual by the fit, {name}"] = (density, look)
    rms = ("rms up to the frequency", "nm")
    _, factor = name_axes(axes, FREQUENCY, rms, xscale="log", yscale="log")
    totals, step = [], np.gradient(f)
    for name, (density, shade) in densities.items():
        values = factor * np.sqrt(np.maximum(np.cumsum(density * step), 0))
        axes.plot(f, values, label=name, **line_style(shade, linewidth=1.2))
        totals += [values[-1]] if values[-1] > 0 else []
    if totals:
        axes.set_ylim(0.2 * min(totals), 1.5 * max(totals))
    axes.set_xlim(f[0], f[-1])


def _draw_innovations(axes: Axes, axis: IdentifiedAxis) -> None:
    """Draw the cumulative periodogram of the innovations less that of white noise."""
    test, f = axis.whiteness, axis.frequency_hz
    even = np.arange(1, test.cumulative.size + 1) / test.cumulative.size
    bound = 100 * kolmogi(0.01) / np.sqrt(test.effective)  # of Kolmogorov's statistic
    excess = 100 * (test.cumulative - even)
    reach = max(2 * bound, 1.2 * float(np.max(np.abs(excess))))
    title = "innovations, less white noise"
    name_axes(axes, FREQUENCY, ("power up to f", "%"), title, xscale="log")
    axes.axhspan(-bound, bound, label="99 % of white noise", color=colour(None), **SHADE)
    axes.plot(f, excess, label="_excess", **line_style(0, linewidth=1.0))
    axes.set(xlim=(f[0], f[-1]), ylim=(-reach, reach))


SEGMENT = 2048  # frames of a segment of the spectra, at most


def run_spectra(run: Simulation) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies [Hz], and the spectra before the correction and after it, (f,) each.

    They are by Welch's method, means over the runs and sums over the axes [nm^2/Hz].
    """
    from scipy.signal import welch  # slow to import

    how: dict[str, Any] = {"nperseg": _segment(run), "detrend": False, "axis": 1}
    f, opened = welch(run.total_nm, run.frame_rate_hz, **how)
    _, residual = welch(run.residual_nm, run.frame_rate_hz, **how)
    return f[1:], *(density.mean(axis=0).sum(axis=-1)[1:] for density in (opened, residual))


def _segment(run: Simulation) -> int:
    """Return how many frames a segment of the spectra of a run has."""
    return min(int(run.residual_nm.shape[1]), SEGMENT)


def exact_spectrum(
    loop: ClosedLoop, truth: Truth, frequency_hz: FloatArray, length: int
) -> FloatArray:
    """One-sided spectrum of the residual, summed over the axes [nm^2/Hz], (f,).

    It is that of means over frames. A sinusoid of amplitude a at f0 adds what Welch's method makes
    of it with a Hann window w of that length: ``a^2 / 2 |W(f - f0)|^2 / (f_s sum w^2)``, W the
    window's Fourier transform.
    """
    from scipy.signal import freqz, get_window  # slow to import

    rate = loop.hardware.frame_rate_hz
    inside = np.clip(frequency_hz, frequency_hz[1] / 2, None)  # spectra may be infinite at 0
    total: FloatArray = random_density(loop, truth, inside, in_image=False).sum(axis=1)
    for line in (line for line in truth.vibrations if not isinstance(line, Vibration)):
        direction = checked_direction(line, loop.hardware)
        seen_nm = np.sinc(line.frequency_hz / rate) * line.amplitude_nm
        residual = seen_nm * loop.sensitivity([line.frequency_hz])[0] @ direction
        power = float(np.sum(np.abs(residual) ** 2)) / 2
        offset = 2 * np.pi * (frequency_hz - line.frequency_hz) / rate
        _, image = freqz(get_window("hann", length), worN=np.abs(offset))
        window = np.abs(image)  # whose squares sum up to 3/8 of its length
        total += power * window**2 / (rate * 0.375 * length)
    return total
