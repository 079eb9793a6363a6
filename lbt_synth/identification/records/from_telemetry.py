"""Records of tip and tilt from telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry
from lbt_synth.identification.records.column_selection import Series, choose_axes
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.contents import Contents
from lbt_synth.identification.records.from_series import build_record
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.units import unit_name
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray, require_instance

_FACTS = ("frame_rate_hz", "delay_frames", "diameter_m", "obstruction")
_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_CONDITION = 1e8


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
    n = telemetry.modes
    chosen = choose_axes(modes, "modes", n, "modes")
    facts = {name: value for name in _FACTS if (value := getattr(telemetry, name)) is not None}
    contents = Contents(facts={name: {"the telemetry": value} for name, value in facts.items()})
    columns = {role: _modal_columns(telemetry, role, chosen, contents.notes) for role in _MATRICES}
    if telemetry.times_s is not None:
        columns["times"] = [Column(name="times_s", values=telemetry.times_s, unit="s")]
    if max(n, telemetry.measurements.shape[1], telemetry.commands.shape[1]) > len(chosen):
        contents.notes.append(f"axes are modes {', '.join(map(str, chosen))} of {n}")
    if _FOREIGN in telemetry.metadata:
        contents.notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    record = build_record(
        Series(kind="closed_loop", role="measurements", columns=columns),
        contents,
        frame_rate_hz=frame_rate_hz,
        delay_frames=delay_frames,
        mirror=telemetry.mirror if mirror is None else mirror,
        unit=unit,
        command_unit=command_unit,
        diameter_m=diameter_m,
        obstruction=obstruction,
        source=(telemetry.name or "telemetry") if source is None else source,
    )
    return cast(LoopRecord, record)


def _modal_columns(seen: Telemetry, role: str, chosen: list[int], notes: list[str]) -> list[Column]:
    """Return the measurements or the commands of the chosen modes."""
    own = seen.measurement_unit if role == "measurements" else seen.command_unit
    series, unit, said = getattr(seen, role), unit_name(own), f"in {own!r}"
    find, word = _MATRICES[role]
    if (matrix := find(seen)) is not None:
        series, said = series @ matrix.T, f"behind {word}"
        # the modes of our own telemetry are in nm
        unit = "nm" if unit or _FOREIGN not in seen.metadata else None
        notes.append(f"{role}: {word} times what was recorded")
    return [Column(name=f"mode {k} {said}", values=series[:, k], unit=unit) for k in chosen]


def _inverse_response(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from measurements to modes, None for the identity."""
    n, q, response = seen.modes, seen.measurements.shape[1], seen.modal_response
    if (response is None and q != n) or (response is not None and q > n > 2):
        raise ProblemError(
            f"this telemetry has {q} measurements and {f'{n} modes' if n != q else 'no modes'}: "
            "slopes without modal coefficients. Multiply them by the reconstructor of the loop: "
            "Telemetry(measurements=slopes @ R.T, slopes=slopes, reconstructor=R, ...)."
        )
    if response is None or np.array_equal(response, np.eye(n)):
        return None
    if q < n or np.linalg.cond(response) > _CONDITION:
        raise ProblemError(
            f"the interaction matrix {response.shape} has no inverse: the {q} measurements do not "
            f"tell {n} modes apart. Give telemetry of tip and tilt alone."
        )
    return np.asarray(np.linalg.pinv(response), dtype=np.float64)


def _influence(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from commands to modes, None for the identity."""
    n, m, influence = seen.modes, seen.commands.shape[1], seen.influence_matrix
    if influence is None and m != n:
        raise ProblemError(
            f"this telemetry has {m} commands of {n} modes, and no influence matrix; give it "
            "to Telemetry(influence_matrix=...), (modes, commands)."
        )
    is_identity = influence is None or np.array_equal(influence, np.eye(n))
    return None if is_identity else influence


_MATRICES = {  # from what was recorded to modes
    "measurements": (_inverse_response, "the inverse of the interaction matrix"),
    "commands": (_influence, "the influence matrix"),
}
