"""The command sigma: singular values of designs, and their margins."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping

import numpy as np

from lbt_synth.cli.loop_views import show_view
from lbt_synth.cli.output import Report
from lbt_synth.design import Design
from lbt_synth.report.figures import sigma_figure
from lbt_synth.report.figures.sigma import sigma_curves
from lbt_synth.storage.rows import column, table_row


@table_row
class SigmaPoint:
    """Largest singular values of a design at one frequency; nan for what it does not have."""

    design: str = column("design", help="Name of the design")
    frequency_hz: float = column("frequency", unit="Hz", help="Frequency")
    error: float = column("disturbances to error", help="Of the estimation error; nm of a loop")
    rejection: float = column("phase to residual", help="Of the rejection")
    noise_transfer: float = column("noise to residual", help="Of the noise transfer")


def run(arguments: Namespace) -> Report:
    """Plot singular values of one or several designs, and print their margins."""
    return show_view(arguments, sigma_figure, _points, SigmaPoint)


def _points(designs: Mapping[str, Design], sensor_gain: float) -> list[SigmaPoint]:
    """Return the points of the curves of designs."""
    points = []
    for name, curves in sigma_curves(designs, sensor_gain=sensor_gain).items():
        f, *parts = curves
        values = [np.full(f.size, np.nan) if part is None else part for part in parts]
        points += [
            SigmaPoint(
                design=name,
                frequency_hz=float(frequency),
                error=float(error),
                rejection=float(rejection),
                noise_transfer=float(noise),
            )
            for frequency, error, rejection, noise in zip(f, *values, strict=True)
        ]
    return points
