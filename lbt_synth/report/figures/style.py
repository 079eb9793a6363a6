"""Settings and axes that all figures share, and how a figure becomes a file."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lbt_synth.storage.atomic_files import require_ending, write_atomically

FIGURE_ENDINGS = (".png", ".pdf", ".svg")
METHOD_LABELS = {"kalman": "Kalman", "hinf": r"H$_\infty$"}

_STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "lines.linewidth": 1.5,
    "figure.dpi": 150,
    "savefig.dpi": 200,
    "svg.hashsalt": "lbt_synth",
}


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib settings of this package, for the time of the block."""
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield


def new_figure(width_in: float, height_in: float) -> Any:
    """Return an empty figure that belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def plain_ticks(axis: Any) -> None:
    """Label an axis of less than two decades with plain numbers."""
    low, high = axis.get_ylim()
    if high / low < 3:
        axis.set_yscale("linear")
    elif high / low < 30:
        number_ticks(axis.yaxis)


def number_ticks(scale: Any) -> None:
    """Label a logarithmic x or y axis with plain numbers: 0.1, 0.2, 0.5 and so on."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    scale.set_major_locator(LogLocator(subs=(1, 2, 5)))
    scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.set_minor_formatter(NullFormatter())


def require_figure_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a figure."""
    return require_ending(path, "a figure", FIGURE_ENDINGS)


def save_figure(figure: Any, path: str | os.PathLike[str]) -> Path:
    """Write a figure, whole or not at all."""
    target = require_figure_name(path)
    ending = target.suffix.lower()
    buffer = io.BytesIO()
    # without a date, the same figure is the same file
    undated: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
    with house_style():
        figure.savefig(buffer, format=ending[1:], metadata=undated.get(ending))
    return write_atomically(target, buffer.getvalue())
