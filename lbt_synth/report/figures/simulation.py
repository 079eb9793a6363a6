"""Figure of a simulation: residual over time, and spectra with and without the correction."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np

from lbt_synth.loop import Simulation
from lbt_synth.report.figures.style import house_style, new_figure
from lbt_synth.report.line_styles import COLOURS


def simulation_figure(run: Simulation, *, title: str = "") -> Any:
    """Residual series and spectra before and after the correction.

    Parameters
    ----------
    run : Simulation
        A run; its first case is drawn, the spectra are means over all cases.
    title : str, optional
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        Series above, spectra below.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> run = lbt.simulate(
    ...     lazy.controller, lbt.Truth(turbulence=None, noise_nm=5.0), hardware=path, frames=512
    ... )
    >>> len(lbt.report.figures.simulation_figure(run).axes)
    2
    """
    from scipy.signal import welch

    _, frames, n = run.residual_nm.shape
    names = ("tip", "tilt") if n <= 2 else [f"mode {i}" for i in range(n)]
    with house_style():
        figure = new_figure(6.3, 5.2)
        series, spectrum = figure.subplots(2, 1)
        time = np.arange(frames) / run.frame_rate_hz
        length = min(frames, 2048)
        for i, colour in zip(range(n), cycle(COLOURS), strict=False):
            residual = run.residual_nm[0, :, i]
            series.plot(time, residual, label=names[i], linewidth=0.6, alpha=0.8, color=colour)
            for data, word, line in (
                (run.total_nm, "open loop", ":"),
                (run.residual_nm, "residual", "-"),
            ):
                f, s = welch(data[:, :, i], fs=run.frame_rate_hz, nperseg=length, axis=1)
                mean = np.maximum(s.mean(axis=0)[1:], 1e-12)
                spectrum.loglog(
                    f[1:],
                    mean,
                    linestyle=line,
                    color=colour,
                    label=f"{names[i]}, {word}",
                    linewidth=1.0,
                )
        series.set(xlabel="time [s]", ylabel="residual [nm rms wavefront]")
        series.legend(loc="upper right")
        spectrum.set(xlabel="frequency [Hz]", ylabel=r"power spectrum [nm$^2$/Hz]")
        spectrum.legend(loc="best", ncols=2)
        if title:
            figure.suptitle(title, fontsize=10)
    return figure
