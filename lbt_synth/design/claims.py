"""Claims: what a design says of itself, how it is printed, and how it is checked."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from lbt_synth.design.certificate import NORM_TOLERANCE, Certificate, Check
from lbt_synth.storage.rows import Column


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What is computed of a design from its matrices alone, once for all its claims.

    Attributes
    ----------
    design : Design
        The design.
    certificate : Certificate
        Checks that rest on no claim, the first one on stability; and the norms of its error.
    kalman : FilterRiccati or None
        The Kalman filter of a filter's problem.
    """

    design: Any
    certificate: Certificate
    kalman: Any = None


def _made_of_it(evidence: Evidence, value: Any) -> Iterable[Check]:
    """Check nothing more: the controller is made of the value, and a file is compared with it."""
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim(Column):
    """A number, or one per mode, that a design says of itself.

    Attributes
    ----------
    name : str
        Its key in gain files and in JSON.
    heading, unit, format : str
        How it is printed.
    checks : callable
        From the evidence and the value claimed to the checks of it.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> [claim.name for claim in lbt.kalman(walk).CLAIMS][:2]
    ['rms', 'gamma']
    """

    checks: Callable[[Evidence, Any], Iterable[Check]] = _made_of_it


def measured_claim(name: str, heading: str) -> Claim:
    """Return the claim of a number of the certificate, which is computed again [nm]."""

    def checks(evidence: Evidence, value: float) -> Iterable[Check]:
        measured = getattr(evidence.certificate, name)
        apart = abs(measured / value - 1) if value > 0 else measured
        yield Check(f"{heading}, against the one claimed", apart, NORM_TOLERANCE, "relative")

    return Claim(name=name, heading=heading, unit="nm", checks=checks)
