"""What an export writes for: a program, its arithmetic, its limits, and the function that writes.

A folder of this room whose ``export`` module has a ``TARGET`` is a target; nothing else lists them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lbt_synth.storage.rows import column, table_row

if TYPE_CHECKING:
    from lbt_synth.interop.export_checks import Exported

CERTIFICATE = ".certificate.json"  # added to the name of what is written: its certificate


@table_row
class Arithmetic:
    """How the program that loads a file computes with it."""

    program: str = column("program")
    precision: str = column("precision")
    sums: str = column("order of sums")
    state: str = column("convention of the state")
    clipping: str = column("clipping")
    limits: str = column("limits")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """A program that runs our controllers.

    Attributes
    ----------
    arithmetic : Arithmetic
        How it computes.
    file : str
        What is written, in words.
    write : callable
        ``write(path, design, gain_digest=..., **options)``, which returns an :class:`Exported`.
    endings : tuple of str
        Ending of the file, and of what goes beside it other than the certificate.
    contents : tuple of str
        Names of the files, where the target writes a folder.
    """

    arithmetic: Arithmetic
    file: str
    write: Callable[..., Exported]
    endings: tuple[str, ...] = ()
    contents: tuple[str, ...] = ()

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the arguments of ``write``."""
        return tuple(signature(self.write).parameters)

    def path_in(self, folder: Path) -> Path:
        """Return a path in a folder that ``write`` takes."""
        return folder / "".join(["k", *self.endings[:1]])


def target_names() -> tuple[str, ...]:
    """Return the names of the targets, sorted, without loading them.

    >>> from lbt_synth.interop.target import target_names
    >>> target_names()
    ('c', 'cacao', 'dao', 'matlab', 'pyrtc')
    """
    exports = Path(__file__).parent.glob("*/export.py")
    return tuple(sorted(path.parent.name for path in exports))


def target_named(name: str) -> Target:
    """Return one target.

    Parameters
    ----------
    name : str
        One of :func:`target_names`.

    Returns
    -------
    Target
        The target.

    Examples
    --------
    >>> from lbt_synth.interop.target import target_named
    >>> target_named("dao").arithmetic.precision
    'single'
    """
    module: Any = import_module(f"lbt_synth.interop.{name}.export")
    found: Target = module.TARGET
    return found
