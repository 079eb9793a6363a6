"""What an export returns: the files it wrote and the error of their arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Files that were written, and how far they are from the controller.

    Attributes
    ----------
    files : tuple of pathlib.Path
        The files.
    error : float
        Largest difference of the commands from those of the controller, over the largest
        command, with the arithmetic of the file: in the closed loop where the design is of one,
        on white noise elsewhere.
    error_single : float
        The same in single precision; inf if the loop is then unstable.
    """

    files: tuple[Path, ...]
    error: float
    error_single: float
