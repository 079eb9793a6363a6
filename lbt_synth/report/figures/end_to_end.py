"""Figure of an end-to-end simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.interop import EndToEndRun
from lbt_synth.report.figures.style import house_style, new_figure
from lbt_synth.report.line_styles import COLOURS

_SHOWN_MAS = 700.0


def end_to_end_figure(run: EndToEndRun) -> Any:
    """Image, tip and tilt over time, and residual of each mode of an end-to-end run.

    Parameters
    ----------
    run : EndToEndRun
        The run.

    Returns
    -------
    matplotlib.figure.Figure
        Three panels.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np
    >>> rng = np.random.default_rng(0)
    >>> run = lbt.interop.EndToEndRun(
    ...     system=lbt.load_config("examples/lbt.yaml").end_to_end.system,
    ...     strehl_series=np.full(40, 0.8),
    ...     other_modes_series=np.full(40, 0.9),
    ...     **{
    ...         name: rng.normal(size=(40, 672))
    ...         for name in ("measurements", "commands", "residual_nm")
    ...     },
    ...     psf=np.eye(60),
    ...     psf_pixel_mas=18.4,
    ...     seed=0,
    ...     settle_frames=400,
    ...     seconds=1.0,
    ... )
    >>> len(lbt.report.figures.end_to_end_figure(run).axes)  # three panels and a colour bar
    4
    """
    from matplotlib.colors import LogNorm

    with house_style():
        figure = new_figure(10.5, 3.4)
        image, time, modes = figure.subplots(1, 3)
        size = run.psf.shape[0]
        reach = min(_SHOWN_MAS, size / 2 * run.psf_pixel_mas)
        low, high = (np.array([-0.5, size - 0.5]) - size // 2) * run.psf_pixel_mas
        peak = float(run.psf.max())
        shown = image.imshow(
            np.maximum(run.psf / peak, 1e-5),
            norm=LogNorm(1e-5, 1),
            cmap="magma",
            origin="lower",
            extent=(low, high, low, high),
            interpolation="nearest",
        )
        image.set(
            xlim=(-reach, reach),
            ylim=(-reach, reach),
            xlabel="x [mas]",
            ylabel="y [mas]",
            title=f"{run.system.imaging_wavelength_um:g} µm, Strehl ratio {100 * run.strehl:.1f} %",
        )
        image.grid(visible=False)
        figure.colorbar(shown, ax=image, label="intensity / peak", shrink=0.85)
        seconds = np.arange(run.frames) / run.system.frame_rate_hz
        for axis, name in enumerate(("tip", "tilt")):
            time.plot(
                seconds,
                run.residual_nm[:, axis],
                color=COLOURS[axis],
                linewidth=0.8,
                label=f"{name}, {run.rms_nm[axis]:.0f} nm rms",
            )
        time.set(xlabel="time [s]", ylabel="residual [nm rms wavefront]", title="tip and tilt")
        time.legend(loc="upper right")
        number = np.arange(1, run.system.modes + 1)
        modes.loglog(number, run.rms_nm, color=COLOURS[0], linewidth=0.8)
        modes.set(xlabel="mode (1 tip, 2 tilt)", ylabel="residual [nm rms]", title="all modes")
    return figure
