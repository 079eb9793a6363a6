"""Settings that all figures share, and how a figure becomes a file."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lbt_synth.storage.atomic_files import require_ending, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURE_ENDINGS = (".png", ".pdf", ".svg")


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib settings of this package, for the time of the block."""
    import matplotlib as mpl

    with mpl.rc_context(_style()):
        yield


@cache
def _style() -> dict[str, Any]:
    import matplotlib as mpl

    path = str(files("lbt_synth.report.figures") / "house.mplstyle")
    return dict(mpl.rc_params_from_file(path, use_default_template=False))


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
