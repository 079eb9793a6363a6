"""Records from telemetry: what was recorded as the modes that are tip and tilt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry
from lbt_synth.identification.records.columns import Column, unit_name
from lbt_synth.identification.records.contents import Contents, choose_axes
from lbt_synth.identification.records.from_columns import FACTS, build_loop
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray

_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_CONDITION = float(np.finfo(np.float64).eps ** -0.5)  # beyond, an inverse is half rounding


def telemetry_record(
    telemetry: Telemetry, *, axes: Sequence[int] | None, mirror: PositionLoop | None, **given: Any
) -> LoopRecord:
    """Make a record of tip and tilt; ``given`` are facts, None where the telemetry has to tell.

    Measurements become modes by the inverse of the interaction matrix, commands by the influence
    matrix, where there are such. A matrix of gains alone, one for each mode, is no mixture: these
    measurements stay as they were recorded, and the sensor gain of the record is what they show of
    a unit of phase.
    """
    n = telemetry.modes
    chosen = choose_axes(axes, n, "modes")
    facts = {name: value for name in FACTS if (value := getattr(telemetry, name)) is not None}
    contents = Contents(facts={name: {"the telemetry": value} for name, value in facts.items()})
    roles = {role: _modal_columns(telemetry, role, chosen, contents.notes) for role in _MATRICES}
    if telemetry.times_s is not None:
        roles["times"] = [Column(name="times_s", values=telemetry.times_s, unit="s")]
    if max(n, telemetry.measurements.shape[1], telemetry.commands.shape[1]) > len(chosen):
        contents.notes.append(f"axes are modes {', '.join(map(str, chosen))} of {n}")
    if _FOREIGN in telemetry.metadata:
        contents.notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    mirror = telemetry.mirror if mirror is None else mirror
    record = build_loop(roles, contents, mirror=mirror, **given)
    return replace(record, imaging_wavelength_um=telemetry.imaging_wavelength_um)


def _modal_columns(seen: Telemetry, role: str, chosen: list[int], notes: list[str]) -> list[Column]:
    """Return the measurements or the commands of the chosen modes."""
    recorded_unit = seen.measurement_unit if role == "measurements" else seen.command_unit
    series, unit, said = getattr(seen, role), unit_name(recorded_unit), f"in {recorded_unit!r}"
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
            f"this telemetry has {q} measurements and {n} modes: slopes without modal "
            "coefficients. Multiply them by the reconstructor of the loop.",
            in_python="As Telemetry(measurements=slopes @ R.T, slopes=slopes, reconstructor=R).",
        )
    if response is None or _is_gains(response, seen):
        return None
    if q < n or np.linalg.cond(response) > _CONDITION:
        raise ProblemError(
            f"the interaction matrix {response.shape} has no inverse: the {q} measurements do not "
            f"tell {n} modes apart. Give telemetry of tip and tilt alone."
        )
    return np.asarray(np.linalg.pinv(response), dtype=np.float64)


def _is_gains(response: FloatArray, seen: Telemetry) -> bool:
    """Whether a response is a gain for each mode; units of other programs are in their matrix."""
    if response.shape != (seen.modes, seen.modes):
        return False
    gains = np.diag(response)
    one = np.array_equal(response, np.eye(seen.modes))
    plain = np.array_equal(response, np.diag(gains)) and bool(np.all(gains > 0))
    return one or (plain and _FOREIGN not in seen.metadata)


def _influence(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from commands to modes, None for the identity."""
    n, m, influence = seen.modes, seen.commands.shape[1], seen.influence_matrix
    if influence is None and m != n:
        raise ProblemError(
            f"this telemetry has {m} commands of {n} modes, and no influence matrix (modes, "
            "commands).",
            in_python="Give it to Telemetry(influence_matrix=...).",
        )
    is_identity = influence is None or np.array_equal(influence, np.eye(n))
    return None if is_identity else influence


_MATRICES = {  # from what was recorded to modes
    "measurements": (_inverse_response, "the inverse of the interaction matrix"),
    "commands": (_influence, "the influence matrix"),
}
