"""The verdict of a report: what its numbers say, in sentences."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.number_text import (
    NO_BREAK,
    fixed_text,
    interval_text,
    listing_text,
    signed_text,
)

KEPT = 0.9  # of its best Strehl ratio, within which a design counts as good


@dataclass(frozen=True, slots=True, kw_only=True)
class GoodRange:
    """Frequency errors around its best over which a design keeps most of its Strehl ratio."""

    low_hz: float  # Lower end [Hz], on the grid of the report
    high_hz: float  # Upper end [Hz]
    whole: bool  # Whether it is the whole range of the report


def good_range(one: DesignAssessment) -> GoodRange | None:
    """Return where a design keeps 90 % of its best Strehl ratio; None where it is unstable."""
    if not one.stable:
        return None
    errors, strehls = one.curve.errors_hz, one.curve.strehl[0, 0]
    good = strehls >= KEPT * np.max(strehls)
    first = last = int(np.argmax(strehls))
    while first > 0 and good[first - 1]:
        first -= 1
    while last < errors.size - 1 and good[last + 1]:
        last += 1
    return GoodRange(
        low_hz=float(errors[first]),
        high_hz=float(errors[last]),
        whole=first == 0 and last == errors.size - 1,
    )


def verdict(report: DesignReport) -> str:
    """Return one paragraph: which design leaves least, which bears errors, what is proved."""
    stable = report.stable
    sentences = []
    if stable:
        sentences.append(_least_sentence(report))
        if report.errors_hz.size > 1:
            sentences += _error_sentences(report)
        sentences.append(_gain_sentence(report))
    unstable = [one.name for one in report.assessments if not one.stable]
    if unstable:
        verb = "is" if len(unstable) == 1 else "are"
        sentences.append(f"{listing_text(unstable)} {verb} UNSTABLE in this loop.")
    sentences.append(_certificate_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|Hz)", NO_BREAK, " ".join(sentences))


def _least_sentence(report: DesignReport) -> str:
    stable = report.stable
    best = min(stable, key=lambda one: one.residual_nm)
    least = fixed_text(best.residual_nm, 1)
    # designs that show the same number as the best are as good
    equal = [one.name for one in stable if fixed_text(one.residual_nm, 1) == least]
    several = len(stable) > 1
    where = " if the vibrations are where the configuration has them"
    sentence = (
        f"{f'Of {len(stable)} stable designs, ' if several else ''}{listing_text(equal)} "
        f"{'leave' if len(equal) > 1 else 'leaves'} {'the least, ' if several else ''}{least} nm "
        "rms (Strehl ratio "
        f"{fixed_text(100 * best.strehl, 1)} %){where if report.config.truth.vibrations else ''}"
    )
    limit = report.limits.limit
    if limit is None or limit.rms_nm <= 0:
        return f"{sentence}."
    return f"{sentence}; no linear controller leaves less than {fixed_text(limit.rms_nm, 1)} nm."


def _error_sentences(report: DesignReport) -> list[str]:
    errors = report.errors_hz
    over = f"{signed_text(float(errors[0]))} to {signed_text(float(errors[-1]))} Hz"
    worst = {one.name: float(np.min(one.curve.strehl)) for one in report.stable}
    most = fixed_text(100 * max(worst.values()), 1)
    tough = [name for name, ratio in worst.items() if fixed_text(100 * ratio, 1) == most]
    sentences = [
        f"Over frequency errors of {over} the worst Strehl ratio is "
        + listing_text([f"{fixed_text(100 * v, 1)} % for {name}" for name, v in worst.items()])
        + (f": {_best_words(tough, len(worst))}." if len(worst) > 1 else ".")
    ]
    parts = []
    for one in report.stable:
        found = good_range(one)
        assert found is not None  # it is stable
        ends = f"from {signed_text(found.low_hz)} to {signed_text(found.high_hz)} Hz"
        parts.append(f"{one.name} {'over all of these errors' if found.whole else ends}")
    sentences.append(f"Within 10 % of its own best Strehl ratio stays {listing_text(parts)}.")
    return sentences


def _best_words(tough: list[str], of: int) -> str:
    """Return which designs bear errors best, or that all bear them alike."""
    if len(tough) == of:
        return "they bear them alike"
    return f"{listing_text(tough)} {'bear' if len(tough) > 1 else 'bears'} them best"


def _gain_sentence(report: DesignReport) -> str:
    parts = []
    for one in report.stable:
        low, high = next(
            (ends for ends in one.sensor_gains if ends[0] <= report.real_gain <= ends[1]),
            (float("nan"), float("nan")),
        )
        parts.append(f"{one.name} for {interval_text(low, high, 3)}")
    return f"Around the real sensor gain the loop is stable with {listing_text(parts)}."


def _certificate_sentence(report: DesignReport) -> str:
    failed = [one.name for one in report.assessments if not one.certified]
    checks = sum(len(one.checks) for one in report.assessments)
    if not failed:
        # a proof about another loop must not be taken for one about this loop
        about = "; they are about the loops that the designs were made for, not about this one"
        about = "" if len(report.stable) == len(report.assessments) else about
        return f"All {checks} checks of the certificates were recomputed and passed{about}."
    return f"The certificate of {listing_text(failed)} does NOT hold."
