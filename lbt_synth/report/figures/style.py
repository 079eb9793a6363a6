"""Settings that all figures share, and how a figure becomes a file."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lbt_synth.storage.atomic_files import require_ending, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURE_ENDINGS = (".png", ".pdf", ".svg")

_STYLE: dict[str, Any] = {
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "axes.titlesize": 8.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.formatter.useoffset": False,
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
    "text.parse_math": False,  # names of files and designs are never read as mathematics
    "svg.hashsalt": "lbt_synth",
    "pdf.fonttype": 42,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib settings of this package, for the time of the block."""
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield


def require_figure_name(path: str | os.PathLike[str]) -> Path:
    """Refuse a file name that is not that of a figure."""
    return require_ending(path, "a figure", FIGURE_ENDINGS)


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure, whole or not at all."""
    target = require_figure_name(path)
    ending = target.suffix.lower()
    buffer = io.BytesIO()
    # without a date, the same figure is the same file
    undated: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
    with house_style():
        figure.savefig(buffer, format=ending[1:], metadata=undated.get(ending))
    return write_atomically(target, buffer.getvalue())
