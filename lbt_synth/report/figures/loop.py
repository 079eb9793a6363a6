"""Figure of closed loops: how much disturbance each rejects, and how much noise it passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import ClosedLoop
from lbt_synth.report.charts.description import Axis, Curve, Mark, Panel, Rule
from lbt_synth.validation import FloatArray

DECADES = 3.6  # of frequency that are drawn, below half the frame rate
_DEEPEST = 1e5  # below the highest value: a zero at the Nyquist frequency is no scale
_POINTS = 1200  # of a grid of frequencies
FREQUENCY = Axis(label="frequency", unit="Hz", log=True)
# Frequencies, largest singular values of the rejection and of the noise transfer, (f,) each; the
# latter are None where the loop is unstable
LoopNorms = tuple[FloatArray, FloatArray | None, FloatArray | None]


def loop_norms(loop: ClosedLoop, lines_hz: Sequence[float] = ()) -> LoopNorms:
    """Return what is drawn of a loop, on a grid that is denser around lines."""
    grid = frequency_grid(loop.hardware.frame_rate_hz, lines_hz)
    if not loop.is_stable:
        return grid, None, None
    return grid, spectral_norms(loop.sensitivity(grid)), spectral_norms(loop.noise_transfer(grid))


def loop_panels(
    norms: Mapping[str, LoopNorms], rules: Sequence[Rule], names: list[str], *, title: str = ""
) -> tuple[Panel, Panel]:
    """Return the panels of rejection and noise transfer; looks follow the order of names."""
    first, second = (
        [stable_curve(name, names, found[0], found[part]) for name, found in norms.items()]
        for part in (1, 2)
    )
    unity = Rule(name="", at=1.0, axis="y")
    return (
        frequency_panel("phase to residual", "-", (*first, unity), rules, title=title),
        frequency_panel("noise to residual", "-", second, rules),
    )


def vibration_rules(lines_hz: Sequence[float], name: str = "vibration") -> list[Rule]:
    """Return what marks the frequencies of vibrations."""
    return [Rule(name=name, at=frequency, dash=3) for frequency in lines_hz]


def frequency_panel(
    label: str, unit: str, marks: Sequence[Mark], rules: Sequence[Rule], *, title: str = ""
) -> Panel:
    """Return a panel of transfer functions over frequency."""
    values = np.concatenate([np.zeros(1), *(mark.y for mark in marks if isinstance(mark, Curve))])
    floor = float(np.max(values)) / _DEEPEST
    low = floor if np.any(values[1:] < floor) and floor > 0 else None
    y = Axis(label=f"\u03c3\u0304, {label}", unit=unit, log=True, low=low)
    return Panel(x=FREQUENCY, y=y, marks=(*marks, *rules), title=title)


def stable_curve(
    name: str, names: Sequence[str], x: ArrayLike, y: ArrayLike | None, *, step: str | None = None
) -> Curve:
    """Return the curve of a design; without values it is in the legend as unstable.

    Its look is its place among the names.
    """
    look = list(names).index(name)
    if y is None:
        return Curve(name=f"{name}: unstable", x=np.zeros(0), y=np.zeros(0), look=look)
    return Curve(name=name, x=np.asarray(x), y=np.asarray(y), look=look, step=step)


def frequency_grid(
    rate_hz: float,
    special_hz: Sequence[float] = (),
    *,
    points: int = _POINTS,
    near: int = 60,
) -> FloatArray:
    """Logarithmic grid up to Nyquist, denser around special frequencies and below Nyquist.

    It has so many points, and so many more near each special one, on either side of it.
    """
    nyquist = rate_hz / 2
    grids = [np.geomspace(nyquist / 10**DECADES, nyquist, points)]
    for centre in (*special_hz, nyquist):
        spread = np.geomspace(1e-4, 0.2, near)
        grids += [centre * (1 + spread), centre * (1 - spread), np.array([centre])]
    grid = np.unique(np.concatenate(grids))
    return grid[(grid > 0) & (grid <= nyquist)]
