"""The verdict on a record: its state, what the residual is made of, and what to change first."""

from __future__ import annotations

import numpy as np

from lbt_synth.design import model_integrator
from lbt_synth.identification.diagnosis.channels import AXES
from lbt_synth.identification.diagnosis.diagnosis import Diagnosis
from lbt_synth.identification.diagnosis.line_origins import LineRow
from lbt_synth.identification.diagnosis.running_loop import law_row
from lbt_synth.identification.prediction.comparison import INTEGRATOR, RAN
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import count_text, listing_text

NARROW = 0.3  # modulus margin
_GOOD_ENOUGH = 1.03  # times the least residual, that no change is worth
_BY_CHANCE = 1.25  # times the least residual, at most, that the errors may excuse
_SIGMAS = 2.0
_NEARLY = 1.15  # times the least residual, that a better gain alone may leave
_MOST_LOST = 0.02  # of the frames
_DELAY_WARNING = "warning: a delay of"
_PARTS = 3  # of the disturbance that are named
_LEAST_PART = 0.05  # of the residual variance, of a part that is named


def diagnosis_verdict(found: Diagnosis) -> tuple[str, str, str]:
    """Return three sentences: the record, what its residual is made of, what to change first."""
    return _state_sentence(found), _residual_sentence(found), _advice_sentence(found)


def _state_sentence(found: Diagnosis) -> str:
    """Say whether the record can be used, and what ran."""
    faults = "; ".join(_faults(found))
    if found.doubt:
        other = f" The record has faults, too: {faults}." if faults else ""
        return f"The commands are not those that the mirror followed: {found.doubt}.{other}"
    if faults:
        return f"The record has faults: {faults}."
    delays = [note for note in found.notes if note.startswith(_DELAY_WARNING)]
    if delays:
        return f"The delay of the record is doubtful: {delays[0].removeprefix('warning: ')}."
    law = "an open loop ran"
    if found.law is not None:
        row = law_row(found.law)
        law = f"a law of order {row.order} ran"
        if found.law.order <= 1:
            law = f"a {row.law} of gain {row.gain} ran"
        if row.lag_frames:
            law += f", {count_text(row.lag_frames, 'frame')} late"
    if found.model is None or found.loop is None:
        return f"The record shows no fault, and {law}."
    gain = f"at the sensor gain of {found.loop.sensor_gain}"
    if found.loop.spectral_radius >= 1:
        return f"The record shows no fault, but {law}, which is UNSTABLE {gain}."
    stable = f", stable {gain}" if found.loop.stable_gains else ""
    if found.loop.modulus < NARROW:
        stable += f" but with a modulus margin of {found.loop.modulus:.2g} only"
    return f"The record is sound: {law}{stable}."


def _faults(found: Diagnosis) -> list[str]:
    """Say which channels are at fault, and how many frames are lost."""
    out = [f"the {row.channel} is {row.state}" for row in found.channels if row.serious]
    lost = 1 - found.record.health.usable / found.record.frames
    if lost > _MOST_LOST:
        out.append(f"{100 * lost:.2g} % of the frames are lost")
    return out


def _residual_sentence(found: Diagnosis) -> str:
    """Say what the loop that ran leaves, and of what."""
    ran = found.row(RAN)
    parts = found.costs[:-1]
    if not parts:
        return "Nothing can be said of its residual."
    total = found.costs[-1]
    by_running = np.isfinite(total.running_nm)
    of = [(row.part, row.running_nm if by_running else row.best_nm) for row in parts]
    whole = total.running_nm if by_running else total.best_nm
    where = {line.name: _direction_text(line.row) for line in found.lines}
    named = [
        f"{nm_text(nm)} of the {part}{where.get(part, '')}"
        for part, nm in of[:_PARTS]
        if nm**2 >= _LEAST_PART * whole**2
    ]
    if not by_running:
        return f"By the model the {found.best} would leave {nm_text(whole)}: {listing_text(named)}."
    measured = doubt = ""
    if ran is not None and np.isfinite(ran.replayed_nm):
        measured = (
            f"It leaves {nm_text(ran.replayed_nm, error_nm=ran.replayed_error_nm)} on unseen data "
            f"(Strehl ratio {ran.strehl:.3f}), by the model "
        )
        doubt = ", which the data contradict" * ran.contradicts_model
    return f"{measured or 'By the model it leaves '}{nm_text(whole)}{doubt}: {listing_text(named)}."


def _direction_text(row: LineRow) -> str:
    """Say along what a line shakes."""
    if row.origin in AXES:
        return f" in {row.origin}"
    return "" if np.isnan(row.direction_deg) else f" along {row.direction_deg:.0f} deg"


def _advice_sentence(found: Diagnosis) -> str:
    """Say what to change first."""
    bad = next((row for row in found.channels if row.serious), None)
    if bad is not None:
        return f"First look at the {bad.channel}, which is {bad.state}."
    if found.doubt:
        return f"First {found.repair}."
    if any(note.startswith(_DELAY_WARNING) for note in found.notes):
        return "First check the delay, on which sensor gain and designs depend."
    ran, best, slow = found.row(RAN), found.row(found.best), found.row(INTEGRATOR)
    if best is None or best.replayed is None:
        return "Record longer before anything is changed."
    bound = ""
    if np.isfinite(found.limit_nm):
        bound = f"; by the model no linear controller leaves less than {nm_text(found.limit_nm)}"
    leaves = f"{nm_text(best.replayed_nm, error_nm=best.replayed_error_nm)}"
    if ran is None or ran.replayed is None:
        return f"The {found.best} leaves least, {leaves} (Strehl ratio {best.strehl:.3f}{bound})."
    difference, error = ran.replayed.above(best.replayed)
    ratio = ran.replayed_nm / best.replayed_nm
    if ratio < _GOOD_ENOUGH or (difference < _SIGMAS * error and ratio < _BY_CHANCE):
        return f"Change nothing: the {found.best} would leave {leaves}{bound}."
    slow_nm = np.nan if slow is None else slow.replayed_nm
    if slow_nm < _NEARLY * best.replayed_nm:
        other = "" if found.best == INTEGRATOR else f", the {found.best} {leaves}"
        return (
            f"First change the gain{_gain_text(found)}: the {INTEGRATOR} leaves {nm_text(slow_nm)} "
            f"on unseen data{other}{bound}."
        )
    return (
        f"First change the controller: the {found.best} leaves {leaves} on unseen data (Strehl "
        f"ratio {best.strehl:.3f}), the {INTEGRATOR} {nm_text(slow_nm)}{bound}."
    )


def _gain_text(found: Diagnosis) -> str:
    """Say from which gain to which, where an integrator ran."""
    law = found.law
    if law is None or law.order != 1 or found.model is None:
        return ""
    design = model_integrator(found.model.plant())
    best = float(np.mean(np.diag(design.controller.B)))
    return f" from {float(np.mean(np.diag(law.gain))):.3g} to {best:.3g}"
