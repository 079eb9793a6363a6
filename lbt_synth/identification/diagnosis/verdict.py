"""The verdict on a record: its state, its residual, and what to change first.

Residuals are those on the second half of the record, with errors. The model says only how the
variance of one divides among the parts of the disturbance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lbt_synth.design import model_integrator
from lbt_synth.identification.diagnosis.diagnosis import Diagnosis
from lbt_synth.identification.diagnosis.rows import FEW
from lbt_synth.identification.prediction.comparison import INTEGRATOR, RAN
from lbt_synth.identification.prediction.residual import MUCH, gather
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import listing_text

_NARROW = 0.3  # modulus margin: less is a gain margin below 1.4
_LEAST_SHARE = 0.05  # of the residual variance, of a part that is named
_DELAY_WARNING = "warning: a delay of"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a record tells, and what it asks for."""

    tone: Literal["good", "note", "bad"] = "bad"
    sentence: str
    advice: str = ""


def diagnosis_findings(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    """Return what a record tells, the most urgent first; the last one is about its residual."""
    faults = list(_find_faults(diagnosis)) or [_judge_loop(diagnosis)]
    return (*faults, Finding(sentence=_residual_text(diagnosis), advice=_advice_text(diagnosis)))


def diagnosis_verdict(diagnosis: Diagnosis) -> tuple[str, str, str]:
    """Return three sentences: the record, what its residual is made of, what to change first."""
    *state, residual = diagnosis_findings(diagnosis)
    advice = next(finding.advice for finding in (*state, residual) if finding.advice)
    return " ".join(finding.sentence for finding in state), residual.sentence, advice


def _find_faults(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Yield what must be changed before anything else can be said."""
    bad = [row for row in diagnosis.channels if row.serious]
    faults = [f"the {row.channel} is {row.state}" for row in bad]
    if diagnosis.record.lost > FEW:
        faults.append(f"{100 * diagnosis.record.lost:.2g} % of the frames are lost")
    if faults:
        advice = f"First look at the {bad[0].channel}, which is {bad[0].state}." if bad else ""
        yield Finding(sentence=f"The record has faults: {'; '.join(faults)}.", advice=advice)
    if diagnosis.commands is not None and diagnosis.doubt:
        yield Finding(
            sentence=f"The commands are not those that the mirror followed: {diagnosis.doubt}.",
            advice=f"First {diagnosis.commands.advice}.",
        )
    for note in diagnosis.notes:
        if note.startswith(_DELAY_WARNING):
            warning = note.removeprefix("warning: ")
            yield Finding(
                tone="note",
                sentence=f"The delay of the record is doubtful: {warning}.",
                advice="First check the delay, on which sensor gain and designs depend.",
            )


def _judge_loop(diagnosis: Diagnosis) -> Finding:
    """Say what ran, and whether it was stable."""
    law, loop = "an open loop ran", diagnosis.loop
    if diagnosis.law is not None:
        law = f"{diagnosis.law.name} ran{diagnosis.law.lag_text}"
    if loop is None:
        return Finding(tone="note", sentence=f"The record shows no fault, and {law}.")
    gain = f"at the sensor gain of {loop.sensor_gain}"
    if loop.spectral_radius >= 1:
        sentence = f"The record shows no fault, but {law}, which is UNSTABLE {gain}."
        return Finding(sentence=sentence)
    stable = f", stable {gain}" if loop.stable_gains else ""
    narrow = bool(loop.modulus < _NARROW)
    if narrow:
        stable += f" but with a modulus margin of {loop.modulus:.2g} only"
    tone: Literal["good", "note"] = "note" if narrow else "good"
    return Finding(tone=tone, sentence=f"The record is sound: {law}{stable}.")


def _residual_text(diagnosis: Diagnosis) -> str:
    """Say what the loop that ran leaves, from which measurement that follows, and of what it is."""
    row, ran = diagnosis.row(RAN), diagnosis.residual(RAN)
    parts = _parts_text(diagnosis, "best_nm" if ran is None else "running_nm")
    if row is None or ran is None:
        if not parts:
            return "Nothing can be said of its residual."
        return f"What the {diagnosis.best} would leave is by the model {parts}."
    y = gather(diagnosis.record.measurements, ran.stretches)
    measured_nm = float(np.sqrt(np.mean(np.sum(y**2, axis=1))))
    noise_nm = float(np.sqrt(np.trace(ran.noise_nm2)))
    by_model = f": by the model {parts}" if parts else ""
    if row.contradicts_model:
        by_model += f"; the data contradict the model, which expects {nm_text(row.model_nm)}"
    return (
        f"It leaves {ran.text} on unseen data ({nm_text(measured_nm)} were measured at this sensor "
        f"gain, and {nm_text(noise_nm)} are noise{_strehl_text(diagnosis, RAN)}){by_model}."
    )


def _strehl_text(diagnosis: Diagnosis, name: str) -> str:
    """Return the Strehl ratio of a row, to go on in a list; empty where it is not known."""
    row = diagnosis.row(name)
    return "" if row is None or np.isnan(row.strehl) else f"; Strehl ratio {row.strehl:.3f}"


def _parts_text(diagnosis: Diagnosis, field: str) -> str:
    """Say which parts of a residual variance are how large by the model, the largest first."""
    named = []
    for row in diagnosis.costs[:-1]:
        share = (getattr(row, field) / getattr(diagnosis.costs[-1], field)) ** 2
        if share >= _LEAST_SHARE:  # not of a residual that is not known
            named.append(f"{100 * share:.0f} % of the {row.part}")
    return listing_text(named)


def _advice_text(diagnosis: Diagnosis) -> str:
    """Say what to change first in a loop whose record has no fault."""
    name = diagnosis.best
    ran, best, slow = (diagnosis.residual(row) for row in (RAN, name, INTEGRATOR))
    if best is None or slow is None:
        return "Record longer before anything is changed."
    strehl = _strehl_text(diagnosis, name)
    if ran is None:
        return f"The {name} leaves least on unseen data: {best.text}{strehl}."
    if not ran.is_clearly_above(best):
        return f"Change nothing: of all that was tried the {name} leaves least, {best.text}."
    if ran.is_clearly_above(slow) and slow.total_nm2 < MUCH**2 * best.total_nm2:
        other = f"{strehl}" if name == INTEGRATOR else f", the {name} {best.text}"
        return (
            f"First change the gain{_gain_text(diagnosis)}: the {INTEGRATOR} leaves {slow.text} on "
            f"unseen data{other}."
        )
    return (
        f"First change the controller: the {name} leaves {best.text} on unseen data{strehl}. The "
        f"{INTEGRATOR} leaves {slow.text}."
    )


def _gain_text(diagnosis: Diagnosis) -> str:
    """Say from which gain to which, where an integrator ran."""
    law = diagnosis.law
    if law is None or law.order != 1 or diagnosis.model is None:
        return ""
    design = model_integrator(diagnosis.model.plant())
    best = float(np.mean(np.diag(design.controller.B)))
    return f" from {float(np.mean(np.diag(law.gain))):.3g} to {best:.3g}"
