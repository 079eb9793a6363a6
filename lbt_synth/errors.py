"""Exceptions of the package.

Every message says what was expected, what came, and what to try. The data behind the
message are on the exception, so that a script need not parse text.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def suggest_word(word: str, known: Iterable[str]) -> str:
    """Return which of the known words was meant, or all of them."""
    import difflib  # not needed for what goes well

    words = list(known)
    close = difflib.get_close_matches(word, words, n=1)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(words)}."


class LbtSynthError(Exception):
    """Base class of every error that this package raises on purpose.

    Attributes
    ----------
    in_python : str
        Advice at the end of the message for scripts alone; the command line leaves it out.
    at_terminal : str
        Advice that the command line alone adds to the message.
    """

    in_python: str = ""
    at_terminal: str = ""

    def __init__(self, message: str = "", **data: Any) -> None:
        advice = data.get("in_python", "")
        super().__init__(f"{message} {advice}" if advice else message)
        for name, value in data.items():
            if not hasattr(type(self), name):
                raise TypeError(f"{type(self).__name__} has no attribute {name!r}.")
            setattr(self, name, value)


# --------------------------------------------------------------------------
# The input is wrong.
# --------------------------------------------------------------------------
class ProblemError(LbtSynthError, ValueError):
    """The input of a computation is wrong."""


class DimensionError(ProblemError):
    """Sizes of matrices or vectors clash."""


class NonFiniteError(ProblemError):
    """An input holds NaN or an infinite value."""


class DefinitenessError(ProblemError):
    """A matrix is not symmetric, or not (semi)definite, where it has to be."""


class CoupledModesError(ProblemError):
    """No rotation of the modes makes disturbance and noise diagonal."""


class DetectabilityError(ProblemError):
    """A mode that does not decay cannot be seen, or is not driven, as it must be.

    Attributes
    ----------
    eigenvalue : complex or None
        The offending eigenvalue of the state matrix.
    eigenvector : (n,) ndarray or None
        Moduli of its eigenvector's entries, one per state, where it was computed.
    """

    eigenvalue: complex | None = None
    eigenvector: Any = None


class RecordError(ProblemError):
    """A record contradicts itself: no model is fitted to it.

    Attributes
    ----------
    explanation : str
        What explains the record better than what was given.
    options : str
        Options of the command line that repair it; empty if nothing does.
    """

    explanation: str = ""
    options: str = ""


class ConfigError(ProblemError):
    """A configuration file is refused.

    Attributes
    ----------
    path : str
        Path of the offending key, for example ``model.vibrations[0].damping``.
    """

    path: str = ""


# --------------------------------------------------------------------------
# The input is right, the computation cannot succeed.
# --------------------------------------------------------------------------
class SynthesisError(LbtSynthError):
    """A design could not be computed or could not be certified."""


class InfeasibleError(SynthesisError):
    """No design meets the demand.

    Attributes
    ----------
    gamma : float or None
        The requested level.
    gamma_least : float or None
        The least level that can be met.
    conflict : tuple of str
        Demands that cannot hold together; without any one of them the rest can.
    """

    gamma: float | None = None
    gamma_least: float | None = None
    conflict: tuple[str, ...] = ()


class NumericalError(SynthesisError):
    """A numerical method did not reach its accuracy.

    Attributes
    ----------
    status : str
        Status that the method reported.
    residual : float or None
        The residual reached.
    """

    status: str = ""
    residual: float | None = None


class CertificateError(SynthesisError):
    """A design failed a check of its certificate, so it is not returned.

    Attributes
    ----------
    failed : tuple of str
        Names of the checks that failed.
    """

    failed: tuple[str, ...] = ()


class UnstableLoopError(SynthesisError):
    """A closed loop is unstable or marginally stable, so it has no residual.

    Attributes
    ----------
    spectral_radius : float
        Largest modulus of the closed loop's poles.
    """

    spectral_radius: float = math.nan


class MissingExtraError(LbtSynthError, ImportError):
    """An optional package is not installed, or not in a version that works here.

    Attributes
    ----------
    extra : str
        The extra that brings it: ``pip install "lbt-synth[extra]"``.
    """

    extra: str = ""


# --------------------------------------------------------------------------
# Files.
# --------------------------------------------------------------------------
class FileError(LbtSynthError):
    """A file cannot be read or written.

    Attributes
    ----------
    path : pathlib.Path or None
        The file.
    """

    path: Path | None = None


class GainFileError(FileError):
    """A gain file cannot be read: it is missing, damaged or foreign."""


class SchemaVersionError(GainFileError):
    """A gain file was written with a layout that this version does not know."""


class TelemetryError(FileError):
    """A telemetry file cannot be read: it is missing, damaged, foreign or of a later layout."""


class OutputError(FileError):
    """A result cannot be written."""


def __dir__() -> list[str]:
    """Show the exceptions alone."""
    return sorted(name for name in globals() if name.endswith("Error"))


@contextmanager
def name_key(key: str) -> Iterator[None]:
    """Turn a ProblemError into a ConfigError on a key; one that names its key passes."""
    try:
        yield
    except ConfigError:
        raise
    except ProblemError as error:
        raise ConfigError(f"{key}: {error}", path=key) from error


@contextmanager
def name_file(source: Path) -> Iterator[None]:
    """Put the name of the file before the message of a ConfigError."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}", path=error.path) from error


@contextmanager
def refuse_config(where: str, path: str = "") -> Iterator[None]:
    """Turn any error of the package into a ConfigError that says where it came from."""
    try:
        yield
    except LbtSynthError as error:
        raise ConfigError(f"{where}: {error}", path=path) from error
