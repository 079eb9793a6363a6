"""Figure of an end-to-end simulation."""

from __future__ import annotations

import numpy as np

from lbt_synth.interop import EndToEndRun
from lbt_synth.report.charts.description import Axis, Curve, Map, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure

_SHOWN_MAS = 700.0
_FAINTEST = 1e-5  # of the peak


def end_to_end_figure(run: EndToEndRun, *, axes: OwnAxes = None) -> Figure:
    """Image, tip and tilt over time, and residual of each mode of an end-to-end run.

    Parameters
    ----------
    run : EndToEndRun
        The run.
    axes : Axes or sequence of Axes, optional
        Your own matplotlib axes to draw on, one per panel; by default a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Three panels.

    Raises
    ------
    ProblemError
        If ``axes`` are not one per panel.

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
    size = run.psf.shape[0]
    place = (np.arange(size) - size // 2) * run.psf_pixel_mas
    reach = min(_SHOWN_MAS, size / 2 * run.psf_pixel_mas)
    image = Map(
        x=place,
        y=place,
        values=np.maximum(run.psf / run.psf.max(), _FAINTEST),
        label="intensity / peak",
        low=_FAINTEST,
        log=True,
    )
    seconds = np.arange(run.frames) / run.system.frame_rate_hz
    number = np.arange(1.0, run.system.modes + 1)
    panels = (
        Panel(
            title=f"{run.system.imaging_wavelength_um:g} µm, Strehl ratio {100 * run.strehl:.1f} %",
            x=Axis(label="x", unit="mas", low=-reach, high=reach),
            y=Axis(label="y", unit="mas", low=-reach, high=reach),
            marks=(image,),
            equal=True,
        ),
        Panel(
            title="all modes",
            x=Axis(label="mode (1 tip, 2 tilt)", log=True),
            y=Axis(label="residual", unit="nm rms", log=True),
            marks=(Curve(name="", x=number, y=run.rms_nm, width=0.8),),
        ),
        Panel(
            title="tip and tilt",
            x=Axis(label="time", unit="s"),
            y=Axis(label="residual", unit="nm rms wavefront"),
            marks=tuple(
                Curve(
                    name=f"{name}, {run.rms_nm[axis]:.0f} nm rms",
                    x=seconds,
                    y=run.residual_nm[:, axis],
                    look=axis,
                    width=0.8,
                    dash=0,
                )
                for axis, name in enumerate(("tip", "tilt"))
            ),
        ),
    )
    return draw_figure(panels, columns=2, axes=axes)
