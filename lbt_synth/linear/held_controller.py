"""The controller of a design, for functions that take either."""

from __future__ import annotations

from typing import Protocol

from lbt_synth.errors import ProblemError
from lbt_synth.linear.state_space import Controller
from lbt_synth.validation import suggest_part


class HasController(Protocol):
    """Anything that holds a controller, such as a design."""

    @property
    def controller(self) -> Controller:
        """The controller."""
        ...


def as_controller(
    given: Controller | HasController, *, others: str = "", any_period: bool = False
) -> Controller:
    """Return a controller, or that of a design; refuse anything else."""
    found = given if isinstance(given, Controller) else getattr(given, "controller", None)
    if isinstance(found, Controller) and found.period > 1 and not any_period:
        raise ProblemError(
            "this needs a controller of the loop's own sensor; got one of several sensors. "
            "simulate, limits, show, verify and export to C take it."
        )
    if not isinstance(found, Controller):
        raise ProblemError(
            f"controller must be a Controller{others}, or a design; got {type(given).__name__}."
            f"{suggest_part(given, Controller)}"
        )
    return found
