"""Linear systems of python-control and scipy, taken and given."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError

SAMPLE_FIRST = (
    'Sample it first: control.sample_system(system, dt, method="bilinear") keeps the H-infinity '
    "norm, which the default, a zero-order hold, does not."
)


def system_parts(system: Any) -> tuple[Any, Any, Any, Any, float]:
    """Return A, B, C, D and the sampling period [s] of a discrete system; refuse anything else.

    It takes a tuple (A, B, C, D), systems of python-control and of ``scipy.signal`` in any form,
    and whatever else has these matrices and ``dt_s``. A period that is not given is 1.
    """
    if isinstance(system, tuple | list) and len(system) == 4:
        A, B, C, D = system
        return A, B, C, D, 1.0
    library = type(system).__module__.partition(".")[0]
    if library == "scipy" and hasattr(system, "to_ss"):
        states = system.to_ss()
        dt = 0 if states.dt is None else states.dt  # scipy writes None in continuous time
        return states.A, states.B, states.C, states.D, _period(dt)
    if library == "control" and not hasattr(system, "A"):
        import control

        system = control.ss(system)
    if all(hasattr(system, name) for name in ("A", "B", "C", "D")):
        dt = system.dt if hasattr(system, "dt") else getattr(system, "dt_s", 0)
        return system.A, system.B, system.C, system.D, _period(dt)
    raise ProblemError(
        "a system must be a StateSpace, a control.StateSpace, a scipy.signal.StateSpace or a "
        f"tuple (A, B, C, D); got {type(system).__name__}."
    )


def control_system(A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, dt_s: float) -> Any:
    """Return a ``control.StateSpace`` with a sampling period."""
    import control

    return control.StateSpace(A, B, C, D, dt_s, remove_useless_states=False)


def _period(dt: Any) -> float:
    if dt is None or dt is True:
        return 1.0
    if dt == 0:
        raise ProblemError(
            f"the system must be in discrete time; got a continuous one (dt = 0). {SAMPLE_FIRST}"
        )
    return float(dt)
