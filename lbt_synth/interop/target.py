"""What an export writes for: a program, its arithmetic, its limits, and the function that writes.

A folder of this room whose ``export`` module has a ``TARGET`` is a target; nothing else lists them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lbt_synth.storage.rows import column, table_row

if TYPE_CHECKING:
    from lbt_synth.design import Design
    from lbt_synth.interop.export_checks import Exported
    from lbt_synth.loop.simulation.run import SteppedController

CERTIFICATE = ".certificate.json"  # ending of the certificate beside what is written


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
    beside : str
        Ending of the file that goes beside it, if there is one, other than the certificate.
    contents : tuple of str
        Names of the files, where the target writes a folder.
    options : tuple of str
        Options of ``write`` that the command line offers.
    runner : callable, optional
        ``runner(design, limit)``, which returns the controller of a design stepped in the
        arithmetic of the target. One that knows its limit clips its commands itself.
    """

    arithmetic: Arithmetic
    file: str
    write: Callable[..., Exported]
    beside: str = ""
    contents: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    runner: Callable[[Design, float], SteppedController] | None = None


def target_names() -> tuple[str, ...]:
    """Return the names of the targets, without loading them.

    Returns
    -------
    tuple of str
        The names, sorted.

    Examples
    --------
    >>> from lbt_synth.interop.target import target_names
    >>> target_names()
    ('c', 'cacao', 'dao', 'iir', 'matlab', 'pyrtc')
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
