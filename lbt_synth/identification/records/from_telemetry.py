"""Records of tip and tilt from telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry
from lbt_synth.identification.records.column_selection import choose_axes
from lbt_synth.identification.records.from_arrays import loop_record
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.units import unit_name
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray, number, require_instance

_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_CONDITION = 1e8
_SAME_RATE = 1e-6


def record_from_telemetry(
    telemetry: Telemetry,
    *,
    modes: Sequence[int] | None = None,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    mirror: PositionLoop | None = None,
    unit: str | None = None,
    command_unit: str | None = None,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    source: str | None = None,
) -> LoopRecord:
    """Make a record of tip and tilt from telemetry.

    Measurements become modes by the inverse of the interaction matrix, commands by the
    influence matrix, where there are such.

    Parameters
    ----------
    telemetry : Telemetry
        What the loop recorded.
    modes : sequence of int, optional
        Tip and tilt among the modes, from 0; all, where there are one or two.
    frame_rate_hz : float, optional
        Frame rate [Hz]; refused where it is not that of the telemetry.
    delay_frames : float, optional
        Total delay [frames], where it is not known, or in place of that of the telemetry.
    mirror : PositionLoop, optional
        Dynamics of the mirror; by default as in the telemetry.
    unit, command_unit : str, optional
        Units of the modal measurements and of the modal commands, where the telemetry does not
        tell them.
    diameter_m, obstruction : float, optional
        Telescope diameter [m], and its central obstruction as a fraction of it, where they are
        not known, or in place of those of the telemetry.
    source : str, optional
        Where it is from; by default the name of the system.

    Returns
    -------
    LoopRecord
        Series in nm, and the faults that were found.

    Raises
    ------
    ProblemError
        If tip and tilt cannot be told among the modes, slopes come without what makes modes of
        them, or a unit or rate is unknown or contradicted.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100),),
    ... )
    >>> run = lbt.simulate(lazy.controller, shake, hardware=path, frames=200)
    >>> seen = lbt.identification.record_from_telemetry(
    ...     lbt.files.telemetry_from_simulation(run, path)
    ... )
    >>> error = seen.pseudo_open_loop()[3:] - run.total_nm[0, 2:-1]  # no noise
    >>> bool(abs(error).max() < 1e-9)
    True
    """
    require_instance(telemetry, Telemetry)
    notes: list[str] = []
    if frame_rate_hz is not None:
        rate, own = number(frame_rate_hz, "frame_rate_hz", above=0), telemetry.frame_rate_hz
        if abs(rate / own - 1) > _SAME_RATE:
            raise ProblemError(
                f"frame_rate_hz must be that of the telemetry, {own:.9g} Hz; got {rate:.9g} Hz."
            )
    chosen = choose_axes(modes, "modes", telemetry.modes, "modes")
    y, y_unit = _modal_measurements(telemetry, unit, notes)
    u, u_unit = _modal_commands(telemetry, command_unit or unit, notes)
    facts: dict[str, Any] = {
        "delay_frames": delay_frames,
        "diameter_m": diameter_m,
        "obstruction": obstruction,
        "mirror": mirror,
    }
    for name, given in facts.items():
        there = getattr(telemetry, name)
        if given is None:
            facts[name] = there
        elif name != "mirror" and there not in (None, given):
            notes.append(f"{name} {given:g} was given; the telemetry has {there:g}")
    if max(telemetry.modes, y.shape[1], telemetry.commands.shape[1]) > len(chosen):
        notes.append(f"axes are modes {', '.join(map(str, chosen))} of {telemetry.modes}")
    if _FOREIGN in telemetry.metadata:
        notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    return loop_record(
        y[:, chosen],
        u[:, chosen],
        frame_rate_hz=telemetry.frame_rate_hz,
        times_s=telemetry.times_s,
        unit=y_unit,
        command_unit=u_unit,
        source=(telemetry.name or "telemetry") if source is None else source,
        notes=notes,
        **facts,
    )


def _modal_measurements(
    seen: Telemetry, unit: str | None, notes: list[str]
) -> tuple[FloatArray, str]:
    """Return the measurements of all modes, and their unit."""
    y, n, q = seen.measurements, seen.modes, seen.measurements.shape[1]
    response = seen.interaction_matrix
    if seen.slopes is not None and response is not None:
        response = None if seen.reconstructor is None else seen.reconstructor @ response
    if (response is None and q != n) or (response is not None and q > n > 2):
        raise ProblemError(
            f"this telemetry has {q} measurements and {f'{n} modes' if n != q else 'no modes'}: "
            "slopes without modal coefficients. Multiply them by the reconstructor of the loop: "
            "Telemetry(measurements=slopes @ R.T, slopes=slopes, reconstructor=R, ...)."
        )
    if response is None or np.array_equal(response, np.eye(n)):
        return y, _choose_unit(seen.measurement_unit, unit, "measurements")
    if q < n or np.linalg.cond(response) > _CONDITION:
        raise ProblemError(
            f"the interaction matrix {response.shape} has no inverse: the {q} measurements do not "
            f"tell {n} modes apart. Give telemetry of tip and tilt alone."
        )
    notes.append("measurements: the inverse of the interaction matrix times what was recorded")
    own = _unit_of_modes(seen, seen.measurement_unit)
    return y @ np.linalg.pinv(response).T, _choose_unit(
        own, unit, "modes behind the interaction matrix"
    )


def _modal_commands(seen: Telemetry, unit: str | None, notes: list[str]) -> tuple[FloatArray, str]:
    """Return the commands of all modes, and their unit."""
    u, n, m, influence = seen.commands, seen.modes, seen.commands.shape[1], seen.influence_matrix
    if influence is None and m != n:
        raise ProblemError(
            f"this telemetry has {m} commands of {n} modes, and no influence matrix; give it "
            "to Telemetry(influence_matrix=...), (modes, commands)."
        )
    if influence is None or np.array_equal(influence, np.eye(n)):
        return u, _choose_unit(seen.command_unit, unit, "commands")
    notes.append("commands: the influence matrix times what was recorded")
    own = _unit_of_modes(seen, seen.command_unit)
    return u @ influence.T, _choose_unit(own, unit, "modes behind the influence matrix")


def _unit_of_modes(seen: Telemetry, unit: str) -> str:
    """Return the unit of the modes behind a matrix: nm in our own telemetry, and of lengths."""
    return "nm" if unit_name(unit) or _FOREIGN not in seen.metadata else ""


def _choose_unit(own: str, given: str | None, what: str) -> str:
    """Return the unit of the telemetry, or the one that was given; refuse a contradiction."""
    known = unit_name(own)
    if given is None:
        if known is None:
            raise ProblemError(
                f"the unit of the {what} is {own!r}, which is none of tip and tilt; give unit."
            )
        return known
    if known is not None and unit_name(given) not in (None, known):
        raise ProblemError(f"unit must be that of the {what}, {known}; got {given!r}.")
    return given
