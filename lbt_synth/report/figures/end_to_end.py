"""Figures of end-to-end simulations: one run, and Table III of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.interop import EndToEndRun
from lbt_synth.methods.registry import design_label
from lbt_synth.report.charts.description import Axis, Curve, Map, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, OwnAxes, draw_figure
from lbt_synth.report.figures.robustness import FREQUENCY_ERROR, SHORT_FREQUENCY_ERROR
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies import EndToEndEntry

_SHOWN_MAS = 700.0  # from the centre of the image to its edges
_FAINTEST = 1e-5  # of the peak
_MOST_WITH_LONG_LABEL = 2  # panels side by side that leave room for the long label of x


def end_to_end_figure(run: EndToEndRun, *, axes: OwnAxes = None) -> Figure:
    """Image, tip and tilt over time, and residual of each mode of an end-to-end run."""
    size = run.psf.shape[0]
    position_mas = (np.arange(size) - size // 2) * run.psf_pixel_mas
    reach_mas = min(_SHOWN_MAS, size / 2 * run.psf_pixel_mas)
    image = Map(
        x=position_mas,
        y=position_mas,
        values=np.maximum(run.psf / run.psf.max(), _FAINTEST),
        label="intensity / peak",
        low=_FAINTEST,
        log=True,
    )
    seconds = np.arange(run.frames) / run.system.frame_rate_hz
    mode_numbers = np.arange(1.0, run.system.modes + 1)
    panels = (
        Panel(
            title=f"{run.system.imaging_wavelength_um:g} µm, Strehl ratio {100 * run.strehl:.1f} %",
            x=Axis(label="x", unit="mas", low=-reach_mas, high=reach_mas),
            y=Axis(label="y", unit="mas", low=-reach_mas, high=reach_mas),
            marks=(image,),
            equal=True,
        ),
        Panel(
            title="all modes",
            x=Axis(label="mode (1 tip, 2 tilt)", log=True),
            y=Axis(label="residual", unit="nm rms", log=True),
            marks=(Curve(name="", x=mode_numbers, y=run.rms_nm, width=0.8),),
        ),
        Panel(
            title="tip and tilt",
            x=Axis(label="time", unit="s"),
            y=Axis(label="residual", unit="nm rms wavefront"),
            marks=tuple(
                Curve(
                    name=f"{name}, {nm_text(run.rms_nm[axis], '.0f', unit='nm rms')}",
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


def end_to_end_table_figure(entries: Sequence[EndToEndEntry]) -> Figure:
    """Strehl ratios of Table III by end-to-end simulation, the modal analysis and the paper."""
    rows = [e for e in entries if e.table == "III" and e.error_hz is not None]
    methods = list(dict.fromkeys(e.method for e in rows))
    x = FREQUENCY_ERROR
    if len(methods) > _MOST_WITH_LONG_LABEL:
        x = SHORT_FREQUENCY_ERROR
    y = Axis(label="Strehl ratio at 2.2 µm", unit="%", low=0, high=100)
    panels = [
        Panel(
            title=design_label(method),
            x=x,
            y=y,
            marks=_method_curves([e for e in rows if e.method == method]),
            height_in=2.3,
        )
        for method in methods
    ]
    return draw_figure(panels, columns=len(methods))


def _method_curves(entries: Sequence[EndToEndEntry]) -> tuple[Curve, ...]:
    """Return the curves of one method; the paper's is left out where it published none."""
    error, paper, modal, strehl, scatter = np.array(
        [(e.error_hz, e.paper, e.modal, e.strehl, e.scatter) for e in entries], dtype=float
    ).T
    style: dict[str, Any] = {"x": error, "marker": "own", "size": 4.0}
    ours = (
        Curve(name="modal, measured optical gain", x=error, y=modal, look=1),
        Curve(name="end to end", y=strehl, error=scatter, look=0, **style),
    )
    if np.isnan(paper[0]):
        return ours
    return (Curve(name="Agapito et al. 2008", y=paper, look=3, **style), *ours)
