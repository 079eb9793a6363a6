"""Export a controller as a MATLAB file, in both output conventions."""

from __future__ import annotations

import io
import os
from dataclasses import replace
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Check, Design
from lbt_synth.interop.export_checks import (
    Exported,
    MatrixForm,
    join_labels,
    provenance_lines,
    rehearsal_error,
    require_exportable,
    write_export,
)
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import (
    ROUNDOFF,
    matrix_rounding,
    prove_written,
    require_proved,
)
from lbt_synth.linear import Controller
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import FloatArray

_TEXT_BYTES = 116  # of the header of a version 5 file; scipy writes the date there
_CONVENTION = (
    "textbook: x(k+1) = A x(k) + B y(k), u(k) = C x(k) + D y(k), as ss and Simulink want it: "
    "ss(textbook.A, textbook.B, textbook.C, textbook.D, dt_s). "
    "new_state: the same A and B, u(k) = C x(k+1) + D y(k), as in the gain file; "
    "textbook.C = new_state.C * A, textbook.D = new_state.C * B + new_state.D."
)


class _Textbook(MatrixForm):
    """A system stepped in the textbook form: the command, then the new state."""

    def step(self, y: FloatArray) -> FloatArray:
        A, B, C, D = self._matrices
        u = self._combine(C, D, y)
        self._state = self._combine(A, B, y)
        return u


def export_mat(
    path: str | os.PathLike[str], design: Design, *, gain_digest: str | None = None
) -> Exported:
    """Write a controller as a MATLAB file (version 5), in both output conventions.

    The structures ``textbook`` and ``new_state`` each have A, B, C and D. In MATLAB,
    ``sys = ss(textbook.A, textbook.B, textbook.C, textbook.D, dt_s)``. Beside them: ``dt_s``
    [s], ``convention``, ``provenance`` (text), and for a loop ``frame_rate_hz`` and
    ``delay_frames``.

    Parameters
    ----------
    path : path-like
        File to write, ending in ``.mat``.
    design : Design
        The design.
    gain_digest : str, optional
        SHA-256 of the gain file, for ``provenance`` (64 hexadecimal digits).

    Returns
    -------
    Exported
        The file, its certificate, the error of the textbook form, and the checks of its loop.

    Raises
    ------
    OutputError
        If the ending is not ``.mat``, or the file cannot be written.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If a check fails with the numbers of the file; ``residual`` holds its value.

    Examples
    --------
    >>> import lbt_synth as lbt, scipy.io, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = lbt.interop.export_mat(pathlib.Path(folder) / "slow.mat", slow).files[0]
    ...     scipy.io.loadmat(file, simplify_cells=True)["textbook"]["D"].tolist()
    [[0.5, 0.0], [0.0, 0.5]]
    """
    target = require_ending(path, "a MATLAB file", (".mat",))
    require_exportable(design)
    textbook = design.controller.to_statespace()
    content: dict[str, Any] = {
        "textbook": {name: getattr(textbook, name) for name in "ABCD"},
        "new_state": {name: getattr(design.controller, name) for name in "ABCD"},
        "dt_s": design.controller.dt_s,
        "convention": _CONVENTION,
        "provenance": "\n".join(join_labels(provenance_lines(design, gain_digest))),
    }
    if design.hardware is not None:
        content["frame_rate_hz"] = design.hardware.frame_rate_hz
        content["delay_frames"] = design.hardware.delay_frames
    error = rehearsal_error(design, _Textbook(textbook, np.float64))
    single = rehearsal_error(design, MatrixForm(design.controller, np.float32))
    data = _mat_bytes(content)
    checks = _prove(design, data)
    require_proved(checks, "double precision, in textbook form", "Design with fewer states.")
    return write_export(
        {target: data},
        target="matlab",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        error=error,
        error_single=single,
        start=lambda _: _Textbook(textbook, np.float64),
    )


def _prove(design: Design, data: bytes) -> tuple[Check, ...]:
    """Check the loop around the textbook form that a file holds; its products round as sums."""
    if design.hardware is None:
        return ()
    from scipy.io import loadmat

    buffer: Any = io.BytesIO(data)  # as for savemat
    form = loadmat(buffer)["textbook"][0, 0]
    whole = np.block([[form["A"], form["B"]], [form["C"], form["D"]]])
    n, m = design.controller.n_states, len(design.controller.C)
    # with the command as further states, the sums of a frame are the new state
    state = np.hstack([whole[:, :n], np.zeros((n + m, m))])
    rows, none = np.eye(n + m), np.zeros((m, whole.shape[1] - n))
    dt_s = design.controller.dt_s
    written = Controller(A=state, B=whole[:, n:], C=rows[n:], D=none, dt_s=dt_s)
    entry = replace(written, B=rows, D=np.zeros((m, n + m)))
    return prove_written(
        design, written, matrix_rounding(whole, entry, rows[:n], ROUNDOFF["double"])
    )


def _mat_bytes(content: dict[str, Any]) -> bytes:
    """Return a version 5 file without its date: the same design gives the same file."""
    from scipy.io import savemat

    buffer: Any = io.BytesIO()  # scipy's own annotation allows only file names
    savemat(buffer, content, format="5", oned_as="column")
    text = f"MATLAB 5.0 MAT-file, written by lbt_synth {lbt_synth.__version__}"
    return text.ljust(_TEXT_BYTES).encode("ascii") + bytes(buffer.getvalue()[_TEXT_BYTES:])


TARGET = Target(
    arithmetic=Arithmetic(
        program="MATLAB and Simulink",
        precision="double",
        sums="matrix products, in an order of their library",
        state="textbook: u(k) = C x(k) + D y(k); new_state: that of the gain file",
        clipping="none: plain form, it assumes that its commands are applied",
        limits="none",
    ),
    file="MATLAB file (.mat)",
    write=export_mat,
    endings=(".mat",),
)
