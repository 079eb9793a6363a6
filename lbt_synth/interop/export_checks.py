"""What all exports share: a rehearsal, text on the origin, the result, and its certificate."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth
from lbt_synth.design import Check, Design, certify_loop
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.interop.arithmetic_cost import FrameCost
from lbt_synth.interop.target import CERTIFICATE, Arithmetic
from lbt_synth.linear import Controller
from lbt_synth.linear.state_space import LinearSystem, RunningController
from lbt_synth.loop.simulation.run import SteppedController, step_loop
from lbt_synth.storage.atomic_files import write_together
from lbt_synth.storage.rows import json_record
from lbt_synth.validation import FloatArray, require_instance

FRAMES = 2000
# without *, \ and ? no text ends a comment, splices lines or makes a trigraph
_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:;+\-=()<>%'/\[\]|]")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_POLE = 0.99  # of the random phase that disturbs the rehearsed loop


def require_certified(design: Design) -> None:
    """Refuse a design that is not certified."""
    require_instance(design, Design)
    if not design.certificate.passed:
        failed = tuple(check.name for check in design.certificate.checks if not check.passed)
        raise CertificateError(
            f"only a certified design is exported; this one failed: {'; '.join(failed)}.",
            failed=failed,
        )


def require_exportable(design: Design, written: Controller | None = None) -> None:
    """Refuse a design that is not certified, or whose loop is unstable with the written numbers.

    A design of several sensors is refused, too: only C source has an input for each of them.
    """
    require_certified(design)
    if design.other_sensors:
        raise ProblemError(
            f"this design reads {', '.join(design.other_sensors)} beside the loop's own sensor, "
            "each when it is due; what this target loads has one matrix, for a loop of one sensor. "
            "Export it to C."
        )
    if design.hardware is None:
        return
    check = certify_loop(design.hardware, written or design.controller)
    if not check.passed:
        raise NumericalError(
            "the loop closed around the numbers as they would be written is unstable: "
            f"{check.name} {check.value:.12g}, limit {check.limit:.12g}. Try double precision.",
            residual=check.value,
        )


def require_modal(design: Design, file: str) -> int:
    """Return the number of modes of a design whose measurements and commands are its modes."""
    hardware = require_hardware(design, file)
    identity = np.eye(hardware.modes)
    for name in ("sensor", "influence"):
        if not np.array_equal(getattr(hardware, name), identity):
            raise ProblemError(
                f"{name}_matrix must be the identity: the RTC reconstructs modes and projects them "
                "on actuators itself. Design for the modes."
            )
    return hardware.modes


class MatrixForm:
    """A controller in new-state form, stepped in a given precision."""

    def __init__(self, controller: LinearSystem, dtype: Any) -> None:
        with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is noticed
            self._matrices = [getattr(controller, name).astype(dtype) for name in "ABCD"]
        self._dtype = dtype
        self.reset()

    def reset(self) -> None:
        """Set the state to zero."""
        self._state = np.zeros(len(self._matrices[0]), dtype=self._dtype)

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        A, B, C, D = self._matrices
        measured = y.astype(self._dtype)
        self._state = self._combine(A, B, measured)
        return np.asarray(self._combine(C, D, measured), dtype=np.float64)

    def _combine(
        self, on_state: npt.NDArray[Any], on_y: npt.NDArray[Any], y: npt.NDArray[Any]
    ) -> npt.NDArray[Any]:
        return np.asarray(on_state @ self._state + on_y @ y)


def rehearsal_error(design: Design, other: SteppedController) -> float:
    """Largest difference of commands from the controller's, over the largest command.

    Both close the loop of the design around the same disturbance (a process of the first
    order) and noise; a controller alone may be unstable, so only its loop can be compared.
    A design without a loop is fed white noise.
    """
    with np.errstate(all="ignore"):  # what overflows is found to be infinite
        expected = _own_commands(design)
        try:
            found = _rehearse(design, other)
        except ProblemError:
            return float("inf")
        size = float(np.max(np.abs(expected)))
        error = float(np.max(np.abs(found - expected)))
    if not np.isfinite(error):
        return float("inf")
    return error / size if size > 0 else error


@lru_cache(maxsize=8)
def _own_commands(design: Design) -> FloatArray:
    """Return the commands of the controller itself, the same for each precision."""
    return _rehearse(design, design.controller.start())


def _rehearse(design: Design, controller: SteppedController | RunningController) -> FloatArray:
    """Return the commands (frames, m) of a controller that takes the place of a design's own."""
    rng = np.random.default_rng(0)
    hardware, q = design.hardware, design.controller.B.shape[1]
    if hardware is None:
        return np.array([controller.step(y) for y in rng.standard_normal((FRAMES, q))])
    n, total = hardware.modes, rng.standard_normal((1, FRAMES, hardware.modes))
    for k in range(1, FRAMES):
        total[0, k] = _POLE * total[0, k - 1] + np.sqrt(1 - _POLE**2) * total[0, k]
    noise = 0.1 * rng.standard_normal((1, FRAMES, q))
    return step_loop(controller, 1.0, hardware, total, noise)[0, :, n : n + hardware.n_commands]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Files that were written, and how far they are from the controller."""

    files: tuple[Path, ...]  # the files
    # largest difference of the commands from those of the controller, over the largest command,
    # with the arithmetic of the file: in the closed loop where the design is of one, on white noise
    # elsewhere
    error: float
    error_single: float  # the same in single precision; inf if the loop is then unstable
    # ``start(limit)``, which returns what was written, stepped in the arithmetic of the target. One
    # that knows its limit clips its commands itself
    start: Callable[[float], SteppedController]
    checks: tuple[Check, ...] = ()  # the proof in the loop, with the numbers of the file
    cost: FrameCost | None = None  # arithmetic of a frame, if what is written is counted
    # whether the coefficients were made again for the arithmetic of the target
    made_again: bool = False


def join_labels(lines: Sequence[tuple[str, str]]) -> list[str]:
    """Join each label and its text."""
    return [f"{label}: {text}" if label else text for label, text in lines]


def provenance_lines(design: Design, gain_digest: str | None) -> list[tuple[str, str]]:
    """Return labelled lines on a file: version, method, gain file, loop, units, certificate."""
    if gain_digest is not None and not _DIGEST.fullmatch(str(gain_digest)):
        raise ProblemError(
            "gain_digest must be the SHA-256 of a gain file, 64 hexadecimal digits; "
            f"got {gain_digest!r}."
        )
    lines = [
        ("written by", f"lbt_synth {lbt_synth.__version__}"),
        ("method", f"{design.method} ({design.solver.route})"),
        ("gain file", "not named" if gain_digest is None else f"SHA-256 {gain_digest}"),
    ]
    hardware = design.hardware
    if hardware is None:
        lines += [("sampling", f"{design.controller.dt_s!r} s"), ("units", "those of the problem")]
    else:
        lines += [
            ("frame rate", f"{hardware.frame_rate_hz!r} Hz"),
            ("delay", f"{hardware.delay_frames!r} frames in total"),
            ("units", "y: nm rms wavefront where the sensor matrix is the identity;"),
            ("", "u: nm rms wavefront where the influence matrix is"),
        ]
    if hardware is not None and design.other_sensors and hardware.suite.channels:
        lines.append(("", "channels of accelerometers: metres per second squared"))
    checks = design.certificate.checks
    lines.append(("certificate", f"{len(checks)} checks passed"))
    lines += [("", f"{c.name}: {c.value:.6g} (limit {c.limit:.6g})") for c in checks]
    return [(label, comment_text(text)) for label, text in lines]


def comment_text(text: str) -> str:
    """Return text without what could end a comment of C."""
    return _UNSAFE.sub("_", text)


def write_export(
    files: dict[Path, bytes],
    *,
    target: str,
    arithmetic: Arithmetic,
    checks: Sequence[Check],
    gain_digest: str | None,
    error: float,
    start: Callable[[float], SteppedController],
    error_single: float | None = None,
    cost: FrameCost | None = None,
    **facts: Any,
) -> Exported:
    """Write files and their certificate, named after the first file; all or none.

    ``facts`` are what else the files depend on. Without another one, the error is that of single
    precision.
    """
    digests = {path.name: hashlib.sha256(data).hexdigest() for path, data in files.items()}
    first, *others = files
    certificate: dict[str, Any] = {
        "target": target,
        "file": first.name,
        "file_sha256": digests[first.name],
        **({"others_sha256": {o.name: digests[o.name] for o in others}} if others else {}),
        "gain_sha256": gain_digest,
        **facts,
        "arithmetic": json_record(arithmetic),
        "checks": [json_record(check) for check in checks],
    }
    text = json.dumps(certificate, indent=2, allow_nan=False) + "\n"
    written = (*files.items(), (first.with_name(first.name + CERTIFICATE), text.encode()))
    return Exported(
        files=write_together(dict(written)),
        error=error,
        error_single=error if error_single is None else error_single,
        start=start,
        checks=tuple(checks),
        cost=cost,
    )
