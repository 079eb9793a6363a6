"""The verdict of a report: what its numbers say, in sentences."""

from __future__ import annotations

import re

import numpy as np

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.number_text import NO_BREAK, fixed_text, signed_text
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import listing_text

KEPT = 0.9  # of its best Strehl ratio, within which a design counts as good


def good_range(one: DesignAssessment) -> tuple[float, float] | None:
    """Return between which frequency errors [Hz] a design keeps 90 % of its best Strehl ratio.

    None where it is unstable.
    """
    if not one.stable:
        return None
    errors, strehls = one.curve.errors_hz, one.curve.strehl[0, 0]
    best = int(np.argmax(strehls))
    poor = np.flatnonzero(strehls < KEPT * np.max(strehls))
    first = int(np.max(poor[poor < best], initial=-1)) + 1
    last = int(np.min(poor[poor > best], initial=errors.size)) - 1
    return float(errors[first]), float(errors[last])


def verdict(report: DesignReport) -> str:
    """Return at most three sentences: which design leaves least, which is robust, what is proved.

    The table of the report has the numbers of all designs.
    """
    sentences = [_certificate_sentence(report)]
    if report.stable and report.errors_hz.size > 1:
        sentences.insert(0, _error_sentence(report))
    if report.stable:
        sentences.insert(0, _least_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|um|mas|urad|Hz)", NO_BREAK, " ".join(sentences))


def _least_sentence(report: DesignReport) -> str:
    stable = report.stable
    best = min(stable, key=lambda one: one.residual_nm)
    shown = {one.name: nm_text(one.residual_nm, ".1f", unit="nm rms") for one in stable}
    least = shown[best.name]
    # designs that show the same number as the best are as good
    equal = [name for name, text in shown.items() if text == least]
    verb = "leave" if len(equal) > 1 else "leaves"
    several = len(stable) > 1
    where = ", if the vibrations are where the configuration has them"
    return (
        f"{f'Of {len(stable)} stable designs, ' if several else ''}{listing_text(equal)} "
        f"{verb} {'the least, ' if several else ''}{least} (Strehl ratio "
        f"{fixed_text(100 * best.strehl, 1)} %){where if report.config.truth.vibrations else ''}."
    )


def _error_sentence(report: DesignReport) -> str:
    """Say which design keeps most of its Strehl ratio over all frequency errors."""
    first, last = (signed_text(float(report.errors_hz[i])) for i in (0, -1))
    worst = {
        one.name: fixed_text(100 * float(np.min(one.curve.strehl)), 1) for one in report.stable
    }
    most = max(worst.values(), key=float)
    tough = [name for name, percent in worst.items() if percent == most]
    if len(worst) == 1:
        who = "the"
    elif len(tough) == len(worst):
        who = "all do equally well: the"
    else:
        who = f"{listing_text(tough)} {'does' if len(tough) == 1 else 'do'} best: the"
    return (
        f"If their frequencies are wrong by {first} to {last} Hz, {who} Strehl ratio is still "
        f"{most} % at worst."
    )


def _certificate_sentence(report: DesignReport) -> str:
    """Say which designs are unstable, and whether all certificates hold."""
    unstable = [one.name for one in report.assessments if not one.stable]
    failed = [one.name for one in report.assessments if not one.certified]
    checks = sum(len(one.checks) for one in report.assessments)
    parts = []
    if unstable:
        verb = "is" if len(unstable) == 1 else "are"
        parts.append(f"{listing_text(unstable)} {verb} UNSTABLE in this loop")
    if failed:
        parts.append(f"the certificate of {listing_text(failed)} does NOT hold")
    elif unstable:  # a proof about another loop must not be taken for one about this loop
        about = "they are about the loops that the designs were made for, not about this one"
        parts.append(f"all {checks} checks of the certificates passed, but {about}")
    else:
        parts.append(f"all {checks} checks of the certificates were recomputed and passed")
    sentence = "; ".join(parts)
    return f"{sentence if unstable else sentence[0].upper() + sentence[1:]}."
