"""Linear systems of python-control and scipy, taken and given."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError


def system_parts(system: Any) -> tuple[Any, Any, Any, Any, float | None]:
    """Return A, B, C, D and the sampling period [s] of a system; None in continuous time.

    It takes a tuple (A, B, C, D), systems of python-control and of ``scipy.signal`` in any form,
    and whatever else has these matrices and ``dt_s``. A period that is not given is 1.
    """
    if isinstance(system, tuple | list) and len(system) == 4:
        A, B, C, D = system
        return A, B, C, D, 1.0
    library = type(system).__module__.partition(".")[0]
    if library == "scipy" and hasattr(system, "to_ss"):
        found = system.to_ss()
        dt = 0 if found.dt is None else found.dt  # scipy writes None in continuous time
        return found.A, found.B, found.C, found.D, _period(dt)
    if library == "control" and not hasattr(system, "A"):
        import control

        system = control.ss(system)
    if all(hasattr(system, name) for name in ("A", "B", "C", "D")):
        dt = system.dt if hasattr(system, "dt") else getattr(system, "dt_s", None) or 0
        return system.A, system.B, system.C, system.D, _period(dt)
    raise ProblemError(
        "a system must be a StateSpace, a ContinuousSystem, a control.StateSpace, a "
        "scipy.signal.StateSpace or a tuple (A, B, C, D); "
        f"got {type(system).__name__}."
    )


def control_system(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, dt_s: float | None
) -> Any:
    """Return a ``control.StateSpace`` with a sampling period; None is continuous time."""
    import control

    dt = 0 if dt_s is None else dt_s
    return control.StateSpace(A, B, C, D, dt, remove_useless_states=False)


def _period(dt: Any) -> float | None:
    if dt is None or dt is True:
        return 1.0
    return None if dt == 0 else float(dt)
