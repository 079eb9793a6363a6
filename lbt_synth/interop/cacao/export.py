"""Export a controller as the predictive filter that cacao multiplies by its modal history."""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.design import Check, Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.interop.cacao.truncation import CutFilter, predictive_filter
from lbt_synth.interop.export_checks import (
    Exported,
    join_labels,
    provenance_lines,
    rehearsal_error,
    require_modal,
    write_export,
)
from lbt_synth.interop.modes import ModalDesign, all_modes
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import require_proved
from lbt_synth.models import LoopHardware
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import FloatArray, integer, number

LONGEST_DELAY = 8  # frames; modalfilter keeps the commands of ten frames


class AppliedFilter:
    """What ``modalfilter`` and ``applyPF`` compute in a frame, in single precision.

    The pseudo-open-loop value of a mode is its measurement less the command that was applied
    ``latency`` frames ago, interpolated between two frames. The matrix multiplies the values of the
    last frames, the newest first, all modes of a frame together; products are added one by one.
    The mirror gets the product itself: a positive command of cacao adds to the measurement, so
    that :meth:`step` returns its negative.

    The matrix (modes, steps * modes) has a row per mode of the command. The latency of cacao's
    index arithmetic is one frame more than the total delay. The limit is that of the modulus of a
    command that is applied; the history holds the applied commands.
    """

    def __init__(self, matrix: ArrayLike, delay_frames: float = 2.0, limit: float = np.inf) -> None:
        self._matrix = np.atleast_2d(np.asarray(matrix, dtype=np.float32))
        modes, columns = self._matrix.shape
        if columns % modes or not columns:
            raise DimensionError(
                f"the matrix must have steps * {modes} columns, a row per mode; got shape "
                f"{self._matrix.shape}."
            )
        latency = np.float32(1 + number(delay_frames, "delay_frames", at_least=1))
        self._whole, self._limit = int(latency), np.float32(limit)
        self._older = np.float32(latency - self._whole)  # weight of the older of two frames
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        modes, columns = self._matrix.shape
        self._history: NDArray[np.float32] = np.zeros((columns // modes, modes), np.float32)
        self._applied: NDArray[np.float32] = np.zeros((self._whole, modes), np.float32)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return u(k) with the sign of our controllers, (modes,)."""
        newer, older = self._applied[-2:]
        late = (self._older * older).astype(np.float64)  # the sum of both is in double precision
        past = (late + (1.0 - float(self._older)) * newer.astype(np.float64)).astype(np.float32)
        self._history[1:] = self._history[:-1].copy()
        self._history[0] = np.asarray(y, dtype=np.float32) - past
        products = self._matrix * self._history.ravel()
        u = np.clip(np.add.accumulate(products, axis=1)[:, -1], -self._limit, self._limit)
        self._applied[1:] = self._applied[:-1].copy()
        self._applied[0] = u
        return 0.0 - u.astype(np.float64)


_FILE = "a predictive filter"
_MOST_NUMBERS = 100_000_000  # of the matrix: 400 MB
_MOST_LOSS = 0.01
_SIGN = "mirror = + PFmat history; the matrix holds the controller with its sign changed"


def export_cacao(
    path: str | os.PathLike[str],
    design: ModalDesign,
    *,
    steps: int | None = None,
    loss: float = _MOST_LOSS,
    modes: int | None = None,
    other_gain: float | None = None,
    hardware: LoopHardware | None = None,
    gain_digest: str | None = None,
) -> Exported:
    """Write a controller as the matrix of cacao's predictive filter, of finite length.

    cacao multiplies a matrix by the recent pseudo-open-loop values of its modes. The controller,
    as a filter of that history, is stable; it is cut after some steps. What is cut off and rounded
    is bounded in the loop before anything is written.

    Parameters
    ----------
    path : path-like
        File to write, ending in ``.fits``. The proof goes beside it, with
        ``.certificate.json`` after its name.
    design : Design, MixedController or ModalFilters
        Design with unit sensor and influence matrices, whose mirror settles at once; or a design
        with integrators for the other modes; or a filter for each mode.
    steps : int, optional
        Steps of the history; by default as many as the loss needs.
    loss : float, optional
        Relative loss of residual, at each sensor gain of the proof, at which the length is chosen;
        at most 0.01, which is the limit of the proof.
    modes : int, optional
        Modes of a frame; by default those of the design. Further ones get no command, without
        ``other_gain``.
    other_gain : float, optional
        Gain of an integrator for each further mode.
    hardware : LoopHardware, optional
        Loop of the integrators, where no filter says which.
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
    target = require_ending(path, _FILE, (".fits",))
    whole = all_modes(design, _FILE, modes=modes, other_gain=other_gain, hardware=hardware)
    limit = number(loss, "loss", above=0, at_most=_MOST_LOSS)
    delay = _require_loop(whole.parts[0].design).delay_frames
    filters = [predictive_filter(own, _require_loop(own)) for own, _ in whole.parts]
    if steps is None:
        count = max(2, *(found.fewest_steps(limit) for found in filters))
    else:
        count = integer(steps, "steps", at_least=2)
    _require_small(count, whole.count)
    # command, step, mode of the history
    cube = np.zeros((whole.count, count, whole.count), dtype=np.float32)
    checks: list[Check] = []
    error = 0.0
    for part, found in zip(whole.parts, filters, strict=True):
        own = -found.taps(count).swapaxes(0, 1).astype(np.float32)
        taps = -own.swapaxes(0, 1).astype(np.float64)
        proved = CutFilter(whole=found, steps=count, taps=taps).prove()
        if not all(check.passed for check in proved):
            arithmetic = f"single precision, cut after {count} steps"
            require_proved(proved, arithmetic, _advice(count, found.fewest_steps(_MOST_LOSS)))
        checks += whole.name_checks(part, proved)
        error = max(error, rehearsal_error(part.design, AppliedFilter(_flat(own), delay)))
        for modes_of_copy in part.copies:
            cube[np.ix_(modes_of_copy, range(count), modes_of_copy)] = own
    first, matrix = whole.parts[0].design, _flat(cube)
    content = _matrix_bytes(matrix, first, provenance_lines(first, gain_digest), count)
    return write_export(
        {target: content},
        target="cacao",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        steps=count,
        modes=whole.count,
        latency_frames=delay + 1,
        sign=_SIGN,
        error=error,
        start=lambda limit: AppliedFilter(matrix, delay, limit),
    )


def _require_loop(design: Design) -> LoopHardware:
    """Return the loop of a design; refuse one that cacao's history does not know."""
    require_modal(design, _FILE)
    hardware = require_hardware(design, _FILE)
    if hardware.mirror is not None or hardware.delay_frames > LONGEST_DELAY:
        raise ProblemError(
            "the mirror must settle at once, with a total delay of at most "
            f"{LONGEST_DELAY} frames: cacao's history knows a delay alone. Use another target."
        )
    return hardware


def _require_small(steps: int, modes: int) -> None:
    """Refuse a matrix that no computer multiplies in a frame."""
    if steps * modes**2 > _MOST_NUMBERS:
        raise NumericalError(
            f"the matrix must have at most {_MOST_NUMBERS:,} numbers; got {steps} steps of {modes} "
            "modes. Give fewer steps or modes, or make a robust design that is a filter of finite "
            "length: pole 0, states null, and as many functions as steps.",
            status="steps",
            residual=steps,
        )


def _advice(steps: int, fewest: int) -> str:
    """Return what to try for a filter that fails."""
    if steps < fewest:
        return f"Give at least {fewest} steps, or none to have them chosen."
    return "Use a target with states, such as c or pyrtc."


def _flat(cube: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the matrix (m, steps * m) of (m, steps, m), the newest frame first."""
    return cube.reshape(len(cube), -1)


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
