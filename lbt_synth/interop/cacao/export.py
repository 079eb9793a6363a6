"""Export a controller as the predictive filter that cacao multiplies by its modal history."""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lbt_synth.design import Design
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.cacao.applied_filter import LONGEST_DELAY, AppliedFilter
from lbt_synth.interop.cacao.truncation import (
    predictive_filter,
    small_gain_check,
    written_filter,
)
from lbt_synth.interop.export_certificate import write_certified
from lbt_synth.interop.export_checks import (
    Exported,
    join_labels,
    provenance_lines,
    rehearsal_error,
    require_exportable,
    require_modal,
)
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import prove_written, require_proved
from lbt_synth.models import LoopHardware
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import integer, number

_MOST_COLUMNS = 600  # steps times modes of a loop that is proved
_MOST_LOSS = 0.01
_HINT = "Give more steps, design with fewer states, or use a target in double precision."
_SIGN = "mirror = + PFmat history; the matrix holds the controller with its sign changed"


def export_cacao(
    path: str | os.PathLike[str],
    design: Design,
    *,
    steps: int | None = None,
    loss: float = _MOST_LOSS,
    gain_digest: str | None = None,
) -> Exported:
    """Write a controller as the matrix of cacao's predictive filter, of finite length.

    cacao multiplies a matrix by the recent pseudo-open-loop values of its modes. The controller,
    as a filter of that history, is stable; it is cut after some steps. The loop is closed around
    the rounded matrix before anything is written.

    Parameters
    ----------
    path : path-like
        File to write, ending in ``.fits``. The proof goes beside it, with the ending
        ``.certificate.json``.
    design : Design
        Design with unit sensor and influence matrices, whose mirror settles at once.
    steps : int, optional
        Steps of the history; by default as many as the loss needs.
    loss : float, optional
        Relative loss of residual, at unit sensor gain, at which the length is chosen; at most
        0.01. The check of the loop allows 0.01 at each sensor gain.
    gain_digest : str, optional
        SHA-256 of the gain file, for the certificate (64 hexadecimal digits).

    Returns
    -------
    Exported
        Matrix and certificate, the error in single precision, and the checks.

    Raises
    ------
    OutputError
        If the ending is another, or a file cannot be written.
    ProblemError
        If the design is not of such a loop, or a number is out of its range.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If the filter is too long, or a check fails; ``residual`` holds its value.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> from astropy.io import fits
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.3)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "slow.fits"
    ...     _ = lbt.interop.export_cacao(file, slow, steps=64)
    ...     fits.getdata(file).shape
    (2, 128)
    """
    target = require_ending(path, "a predictive filter", (".fits",))
    require_exportable(design)
    hardware = _require_loop(design)
    modes = hardware.modes
    limit = number(loss, "loss", above=0, at_most=_MOST_LOSS)
    found = predictive_filter(design)
    if steps is None:
        # what is cut off adds as power where it is independent of the residual, else as amplitude
        counts = [found.fewest_steps(bound) for bound in (np.sqrt(limit), limit)]
    else:
        counts = [integer(steps, "steps", at_least=2)]
    lines = provenance_lines(design, gain_digest)
    for count in counts:
        if count * modes > _MOST_COLUMNS:
            raise NumericalError(
                f"steps times modes must be at most {_MOST_COLUMNS} for a proof; got {count} steps "
                f"of {modes} modes. Give fewer steps, or make a robust design that is a filter of "
                "finite length: pole 0, states null, and as many functions as steps.",
                status="steps",
                residual=count,
            )
        matrix = filter_matrix(found.taps(count))
        taps = -matrix.astype(np.float64).reshape(modes, count, modes).swapaxes(0, 1)
        checks = (
            *prove_written(design, *written_filter(taps, hardware)),
            small_gain_check(found, taps),
        )
        if all(check.passed for check in checks):
            break
    require_proved(checks, f"single precision, cut after {count} steps", _HINT)
    error = rehearsal_error(design, AppliedFilter(matrix, hardware.delay_frames))
    content = _matrix_bytes(matrix, design, lines, count)
    files = write_certified(
        {target: content},
        target="cacao",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        steps=count,
        modes=modes,
        latency_frames=hardware.delay_frames + 1,
        sign=_SIGN,
    )
    return Exported(
        files=files,
        error=error,
        error_single=error,
        start=lambda limit: AppliedFilter(matrix, hardware.delay_frames, limit),
        checks=checks,
    )


def _require_loop(design: Design) -> LoopHardware:
    """Return the loop of a design; refuse one that cacao's history does not know."""
    require_modal(design, "a predictive filter")
    hardware = design.hardware
    assert hardware is not None  # require_modal refuses a design without a loop
    if hardware.mirror is not None or hardware.delay_frames > LONGEST_DELAY:
        raise ProblemError(
            "the mirror must settle at once, with a total delay of at most "
            f"{LONGEST_DELAY} frames: cacao's history knows a delay alone. Use another target."
        )
    return hardware


def filter_matrix(taps: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the matrix (m, steps * m) of taps (steps, m, m), the newest frame first."""
    return np.ascontiguousarray(-np.hstack([*taps]), dtype=np.float32)


def _matrix_bytes(
    matrix: NDArray[np.float32], design: Design, lines: list[tuple[str, str]], steps: int
) -> bytes:
    """Return a FITS file with the matrix as its primary image, which milk loads as a stream."""
    from astropy.io import fits

    unit = fits.PrimaryHDU(data=matrix)
    cards: dict[str, Any] = {
        "METHOD": (design.method, "synthesis"),
        "STEPS": (steps, "frames of history, the newest first"),
        "MODES": (len(matrix), "modes of a frame"),
    }
    unit.header.update(cards)
    for line in (*join_labels(lines), _SIGN):
        unit.header.add_comment(line)
    unit.add_checksum(when="of this unit")
    buffer = io.BytesIO()
    unit.writeto(buffer)
    return buffer.getvalue()


TARGET = Target(
    arithmetic=Arithmetic(
        program="cacao's applyPF, behind its modalfilter",
        precision="single",
        sums="per command, the newest frame first; on a GPU in any order, which the proof covers",
        state="past pseudo-open-loop values: measurements less past applied commands",
        clipping="none after the filter; the history must hold the applied commands",
        limits="finite impulse response; a mirror that settles, a delay of at most 8 frames",
    ),
    file="matrix of single precision (.fits) and its certificate",
    write=export_cacao,
    endings=(".fits",),
)
