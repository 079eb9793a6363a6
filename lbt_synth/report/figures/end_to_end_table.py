"""Figure of Table III end to end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.report.figures.style import METHOD_LABELS, house_style, new_figure
from lbt_synth.report.line_styles import COLOURS, MARKERS
from lbt_synth.studies import EndToEndEntry


def end_to_end_table_figure(entries: Sequence[EndToEndEntry]) -> Any:
    """Table III end to end, beside the paper and the modal prediction."""
    rows = [e for e in entries if e.table == "III" and e.error_hz is not None]
    methods = list(dict.fromkeys(e.method for e in rows))
    with house_style():
        figure = new_figure(3.6 * len(methods), 3.4)
        axes = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
        for panel, method in zip(axes, methods, strict=True):
            mine = [e for e in rows if e.method == method]
            error = [e.error_hz for e in mine]
            if not np.isnan(mine[0].paper):
                panel.plot(
                    error,
                    [e.paper for e in mine],
                    color="0.35",
                    linestyle=":",
                    marker=MARKERS[1],
                    markersize=3.5,
                    label="Agapito et al. 2008",
                )
            panel.plot(
                error,
                [e.modal for e in mine],
                color=COLOURS[1],
                linestyle="--",
                zorder=3,
                label="modal, measured optical gain",
            )
            scatter = [0.0 if np.isnan(e.scatter) else e.scatter for e in mine]
            panel.errorbar(
                error,
                [e.strehl for e in mine],
                yerr=scatter,
                color=COLOURS[0],
                marker=MARKERS[0],
                markersize=4,
                capsize=2,
                label="end to end",
            )
            panel.set(
                xlabel="frequency of the model less the true one [Hz]",
                title=METHOD_LABELS.get(method, method),
                ylim=(0, 100),
            )
        axes[0].set_ylabel("Strehl ratio at 2.2 µm [%]")
        axes[0].legend(loc="lower center")
    return figure
