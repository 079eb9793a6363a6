"""The verdict on a record in three sentences: its state, its residual, and what to change first.

Residuals are those on the second half of the record, with errors. The model says only how the
variance of one divides among the parts of the disturbance.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.design import model_integrator
from lbt_synth.identification.diagnosis.diagnosis import Diagnosis
from lbt_synth.identification.diagnosis.rows import FEW
from lbt_synth.identification.prediction.comparison import INTEGRATOR, RAN
from lbt_synth.identification.prediction.residual import ResidualEstimate, gather
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import listing_text

NARROW = 0.3  # modulus margin: less is a gain margin below 1.4
_GOOD_ENOUGH = 1.03  # times the least residual, that no change is worth
_MUCH = 1.25  # times a residual: lines that beat for long have errors that would excuse it
_SIGMAS = 2.0  # of a difference that is no chance
_LEAST_SHARE = 0.05  # of the residual variance, of a part that is named
_DELAY_WARNING = "warning: a delay of"


def diagnosis_verdict(diagnosis: Diagnosis) -> tuple[str, str, str]:
    """Return three sentences: the record, what its residual is made of, what to change first."""
    return _state_sentence(diagnosis), _residual_sentence(diagnosis), _advice_sentence(diagnosis)


def _state_sentence(diagnosis: Diagnosis) -> str:
    """Say whether the record can be used, and what ran."""
    faults = "; ".join(_faults(diagnosis))
    if diagnosis.doubt:
        other = f" The record has faults, too: {faults}." if faults else ""
        return f"The commands are not those that the mirror followed: {diagnosis.doubt}.{other}"
    if faults:
        return f"The record has faults: {faults}."
    if warnings := _delay_warnings(diagnosis):
        return f"The delay of the record is doubtful: {warnings[0].removeprefix('warning: ')}."
    law, loop = "an open loop ran", diagnosis.loop
    if diagnosis.law is not None:
        law = f"{diagnosis.law.name} ran{diagnosis.law.lag_text}"
    if loop is None:
        return f"The record shows no fault, and {law}."
    gain = f"at the sensor gain of {loop.sensor_gain}"
    if loop.spectral_radius >= 1:
        return f"The record shows no fault, but {law}, which is UNSTABLE {gain}."
    stable = f", stable {gain}" if loop.stable_gains else ""
    if loop.modulus < NARROW:
        stable += f" but with a modulus margin of {loop.modulus:.2g} only"
    return f"The record is sound: {law}{stable}."


def _faults(diagnosis: Diagnosis) -> list[str]:
    """Say which channels are at fault, and how many frames are lost."""
    faults = [f"the {row.channel} is {row.state}" for row in diagnosis.channels if row.serious]
    if diagnosis.record.lost > FEW:
        faults.append(f"{100 * diagnosis.record.lost:.2g} % of the frames are lost")
    return faults


def _delay_warnings(diagnosis: Diagnosis) -> list[str]:
    return [note for note in diagnosis.notes if note.startswith(_DELAY_WARNING)]


def _residual_sentence(diagnosis: Diagnosis) -> str:
    """Say what the loop that ran leaves, and of what."""
    ran = diagnosis.residual(RAN)
    running = "running_nm" if ran is not None else "best_nm"
    parts = _parts_text(diagnosis, running)
    if ran is None:
        if not parts:
            return "Nothing can be said of its residual."
        return f"What the {diagnosis.best} would leave is by the model {parts}."
    row = diagnosis.row(RAN)
    doubt = ""
    if row is not None and row.contradicts_model:
        doubt = f"; the data contradict the model, which expects {nm_text(row.model_nm)}"
    by_model = f": by the model {parts}" if parts else ""
    measured = _measured_text(diagnosis, ran)
    return f"It leaves {ran.text} on unseen data ({measured}){by_model}{doubt}."


def _measured_text(diagnosis: Diagnosis, ran: ResidualEstimate) -> str:
    """Say from which measurement the residual of what ran follows, and its Strehl ratio."""
    y = gather(diagnosis.record.measurements, ran.stretches)
    measured_nm = float(np.sqrt(np.mean(np.sum(y**2, axis=1))))
    noise_nm = float(np.sqrt(np.trace(ran.noise_nm2)))
    return (
        f"{nm_text(measured_nm)} were measured at this sensor gain, and {nm_text(noise_nm)} are "
        f"noise{_strehl_text(diagnosis, RAN)}"
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
            named.append(f"{100 * share:.0f} % of the {row.part}{row.where}")
    return listing_text(named)


def _advice_sentence(diagnosis: Diagnosis) -> str:
    """Say what to change first."""
    bad = next((row for row in diagnosis.channels if row.serious), None)
    if bad is not None:
        return f"First look at the {bad.channel}, which is {bad.state}."
    if diagnosis.doubt and diagnosis.commands is not None:
        return f"First {diagnosis.commands.advice}."
    if _delay_warnings(diagnosis):
        return "First check the delay, on which sensor gain and designs depend."
    name = diagnosis.best
    ran, best = diagnosis.residual(RAN), diagnosis.residual(name)
    slow = diagnosis.residual(INTEGRATOR)
    if best is None or slow is None:
        return "Record longer before anything is changed."
    strehl = _strehl_text(diagnosis, name)
    if ran is None:
        return f"The {name} leaves least on unseen data: {best.text}{strehl}."
    if not _leaves_more(ran, best):
        return f"Change nothing: of all that was tried the {name} leaves least, {best.text}."
    leaves = f"the {name} leaves {best.text} on unseen data{strehl}"
    if name == INTEGRATOR:
        return f"First change the gain{_gain_text(diagnosis)}: {leaves}."
    if _leaves_more(ran, slow) and slow.total_nm2 < _MUCH**2 * best.total_nm2:
        other = f"the {INTEGRATOR} leaves {slow.text} on unseen data, the {name} {best.text}"
        return f"First change the gain{_gain_text(diagnosis)}: {other}."
    return f"First change the controller: {leaves}. The {INTEGRATOR} leaves {slow.text}."


def _leaves_more(residual: ResidualEstimate, other: ResidualEstimate) -> bool:
    """Whether a residual is above another one by more than chance, or by much."""
    difference, error = residual.above(other)
    ratio = 1 + difference / max(other.total_nm2, other.total_error_nm2)  # of variances
    return ratio > (_GOOD_ENOUGH if difference > _SIGMAS * error else _MUCH) ** 2


def _gain_text(diagnosis: Diagnosis) -> str:
    """Say from which gain to which, where an integrator ran."""
    law = diagnosis.law
    if law is None or law.order != 1 or diagnosis.model is None:
        return ""
    design = model_integrator(diagnosis.model.plant())
    best = float(np.mean(np.diag(design.controller.B)))
    return f" from {float(np.mean(np.diag(law.gain))):.3g} to {best:.3g}"
