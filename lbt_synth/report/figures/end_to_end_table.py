"""Figure of Table III end to end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.methods.registry import design_label
from lbt_synth.report.charts.description import Axis, Curve, Panel
from lbt_synth.report.charts.matplotlib_charts import Figure, draw_figure
from lbt_synth.report.figures.robustness import FREQUENCY_ERROR
from lbt_synth.studies import EndToEndEntry


def end_to_end_table_figure(entries: Sequence[EndToEndEntry]) -> Figure:
    """Table III end to end, beside the paper and the modal prediction."""
    rows = [e for e in entries if e.table == "III" and e.error_hz is not None]
    methods = list(dict.fromkeys(e.method for e in rows))
    y = Axis(label="Strehl ratio at 2.2 µm", unit="%", low=0, high=100)
    panels = [
        Panel(
            title=design_label(method),
            x=FREQUENCY_ERROR if len(methods) < 3 else Axis(label="frequency error", unit="Hz"),
            y=y,
            marks=_method_curves([e for e in rows if e.method == method]),
            height_in=2.3,
        )
        for method in methods
    ]
    return draw_figure(panels, columns=len(methods))


def _method_curves(mine: Sequence[EndToEndEntry]) -> tuple[Curve, ...]:
    error, paper, modal, strehl, scatter = np.array(
        [(e.error_hz, e.paper, e.modal, e.strehl, e.scatter) for e in mine], dtype=float
    ).T
    style: dict[str, Any] = {"x": error, "marker": "own", "size": 4.0}
    ours = (
        Curve(name="modal, measured optical gain", x=error, y=modal, look=1),
        Curve(name="end to end", y=strehl, error=scatter, look=0, **style),
    )
    if np.isnan(paper[0]):
        return ours
    return (Curve(name="Agapito et al. 2008", y=paper, look=3, **style), *ours)
