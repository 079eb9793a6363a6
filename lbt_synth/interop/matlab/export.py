"""The target MATLAB: one file with a controller in both output conventions."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.interop.c.terms import RunningSource, SourceTerms, as_computed, controller_terms
from lbt_synth.interop.pipeline import Target
from lbt_synth.interop.proof import command_as_state
from lbt_synth.linear import StateSpace

_TEXT_BYTES = 116  # of the header of a version 5 file; scipy writes the date there
_CONVENTION = (
    "textbook: x(k+1) = A x(k) + B y(k), u(k) = C x(k) + D y(k), as ss and Simulink want it: "
    "ss(textbook.A, textbook.B, textbook.C, textbook.D, dt_s). "
    "new_state: the same A and B, u(k) = C x(k+1) + D y(k), as in the gain file; "
    "textbook.C = new_state.C * A, textbook.D = new_state.C * B + new_state.D."
)


def _round(designs: Sequence[Design], **_: Any) -> list[SourceTerms]:
    """Return the sums of the textbook form of a controller."""
    textbooks = (design.controller.to_statespace() for design in designs)
    return [controller_terms(command_as_state(textbook)) for textbook in textbooks]


def _write(
    place: Path, _: SourceTerms, design: Design, origin: Sequence[str], **__: Any
) -> dict[Path, bytes]:
    """Return a version 5 file without its date: the same design gives the same file."""
    from scipy.io import savemat

    textbook = design.controller.to_statespace()
    content: dict[str, Any] = {
        "textbook": {name: getattr(textbook, name) for name in "ABCD"},
        "new_state": {name: getattr(design.controller, name) for name in "ABCD"},
        "dt_s": design.controller.dt_s,
        "convention": _CONVENTION,
        "provenance": "\n".join(origin),
    }
    if design.hardware is not None:
        content["frame_rate_hz"] = design.hardware.frame_rate_hz
        content["delay_frames"] = design.hardware.delay_frames
    buffer: Any = io.BytesIO()  # scipy's own annotation allows only file names
    savemat(buffer, content, format="5", oned_as="column")
    text = f"MATLAB 5.0 MAT-file, written by lbt_synth {lbt_synth.__version__}"
    header = text.ljust(_TEXT_BYTES).encode("ascii")
    return {place: header + bytes(buffer.getvalue()[_TEXT_BYTES:])}


def _read(files: Mapping[Path, bytes], like: SourceTerms) -> SourceTerms:
    """Return the sums of the textbook form that a file holds."""
    from scipy.io import loadmat

    buffer: Any = io.BytesIO(next(iter(files.values())))  # as for savemat
    form = loadmat(buffer)["textbook"][0, 0]
    textbook = StateSpace(**{name: form[name] for name in "ABCD"}, dt_s=like.dt_s)
    return controller_terms(command_as_state(textbook))


TARGET = Target(
    precision="double",
    round=_round,
    write=_write,
    read=_read,
    computed=as_computed,
    start=lambda terms, _: RunningSource(terms),
    hint="Design with fewer states.",
    endings=(".mat",),
)
