"""Where an exported file comes from, in text that is safe inside any comment."""

from __future__ import annotations

import re
from collections.abc import Sequence

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError

# without *, \ and ? no text ends a comment, splices lines or makes a trigraph
_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:;+\-=()<>%'/\[\]|]")
_DIGEST = re.compile(r"[0-9a-f]{64}")


def plain_text(text: str) -> str:
    """Replace every character that is not safe in a comment with an underscore."""
    return _UNSAFE.sub("_", text)


def join_labels(lines: Sequence[tuple[str, str]]) -> list[str]:
    """Join each label and its text."""
    return [f"{label}: {text}" if label else text for label, text in lines]


def provenance_lines(design: Design, gain_digest: str | None) -> list[tuple[str, str]]:
    """Return labelled lines on a file: version, method, gain file, loop, units, certificate."""
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
