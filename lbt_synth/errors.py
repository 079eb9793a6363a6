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
    """A mode that does not decay cannot be seen, or is not driven, as it must be."""

    eigenvalue: complex | None = None  #: the offending one of the state matrix
    eigenvector: Any = None  #: (n,): moduli of its entries, one per state, where it was computed


class RecordError(ProblemError):
    """A record contradicts itself: no model is fitted to it."""

    explanation: str = ""  #: what explains the record better than what was given
    options: str = ""  #: options of the command line that repair it; empty if nothing does


class ConfigError(ProblemError):
    """A configuration file is refused."""

    path: str = ""  #: of the offending key, for example ``model.vibrations[0].damping``


# --------------------------------------------------------------------------
# The input is right, the computation cannot succeed.
# --------------------------------------------------------------------------
class SynthesisError(LbtSynthError):
    """A design could not be computed or could not be certified."""


class InfeasibleError(SynthesisError):
    """No design meets the demand."""

    gamma: float | None = None  #: the requested level
    gamma_least: float | None = None  #: the least level that can be met
    #: demands that cannot hold together; without any one of them the rest can
    conflict: tuple[str, ...] = ()


class NumericalError(SynthesisError):
    """A numerical method did not reach its accuracy."""

    status: str = ""  #: that the method reported
    residual: float | None = None  #: that was reached


class CertificateError(SynthesisError):
    """A design failed a check of its certificate, so it is not returned."""

    failed: tuple[str, ...] = ()  #: names of the checks


class UnstableLoopError(SynthesisError):
    """A closed loop is unstable or marginally stable, so it has no residual."""

    spectral_radius: float = math.nan  #: largest modulus of the closed loop's poles


class MissingExtraError(LbtSynthError, ImportError):
    """An optional package is not installed, or not in a version that works here."""

    extra: str = ""  #: that brings it: ``pip install "lbt-synth[extra]"``


# --------------------------------------------------------------------------
# Files.
# --------------------------------------------------------------------------
class FileError(LbtSynthError):
    """A file cannot be read or written."""

    path: Path | None = None  #: the file


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
