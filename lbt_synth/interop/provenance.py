"""Where a file comes from, in words that are safe in any comment."""

from __future__ import annotations

import re
from collections.abc import Sequence

import lbt_synth
from lbt_synth.design import Design, certify_loop
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.validation import instance

# no asterisk, backslash or question mark: no end of a comment, spliced line or trigraph
_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:;+\-=()<>%'/\[\]|]")
_DIGEST = re.compile(r"[0-9a-f]{64}")


def plain_text(text: str) -> str:
    """Return a text of plain characters only; every other one becomes an underscore."""
    return _UNSAFE.sub("_", text)


def require_sound(design: Design, written: Controller | None = None) -> None:
    """Refuse a design that is not certified, or whose loop what is written would not hold."""
    instance(design, Design)
    if not design.certificate.passed:
        failed = tuple(check.name for check in design.certificate.checks if not check.passed)
        raise CertificateError(
            f"only a certified design is exported; this one failed: {'; '.join(failed)}.",
            failed=failed,
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


def as_sentences(lines: Sequence[tuple[str, str]]) -> list[str]:
    """Return lines of provenance as texts."""
    return [f"{label}: {text}" if label else text for label, text in lines]


def provenance(design: Design, gain_digest: str | None) -> list[tuple[str, str]]:
    """Return labels and texts that say what a file holds and where it comes from."""
    if gain_digest is not None and not (
        isinstance(gain_digest, str) and _DIGEST.fullmatch(gain_digest)
    ):
        raise ProblemError(
            "gain_digest must be the SHA-256 of a gain file, 64 hexadecimal digits; "
            f"got {gain_digest!r}."
        )
    lines = [
        ("written by", f"lbt_synth {lbt_synth.__version__}"),
        ("method", f"{design.method} ({design.solver.route})"),
        ("gain file", "not named" if gain_digest is None else f"SHA-256 {gain_digest}"),
    ]
    if design.hardware is None:
        lines += [
            ("sampling", f"{design.controller.dt_s!r} s"),
            ("units", "those of the problem"),
        ]
    else:
        lines += [
            ("frame rate", f"{design.hardware.frame_rate_hz!r} Hz"),
            ("delay", f"{design.hardware.delay_frames!r} frames in total"),
            ("units", "y: nm rms wavefront where the sensor matrix is the identity;"),
            ("", "u: nm rms wavefront where the influence matrix is"),
        ]
    checks = design.certificate.checks
    lines.append(("certificate", f"{len(checks)} checks passed"))
    lines += [("", f"{c.name}: {c.value:.6g} (limit {c.limit:.6g})") for c in checks]
    return [(label, plain_text(text)) for label, text in lines]
