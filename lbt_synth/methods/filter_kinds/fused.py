"""What ``show`` says of a filter of several sensors, and what a gain file holds of it."""

from __future__ import annotations

from lbt_synth.design.fusion.failures import failure_rows
from lbt_synth.design.fusion.fused_filter import FusedFilter
from lbt_synth.design.fusion.record import rebuild_fused, record_fused
from lbt_synth.methods.filters import FilterKind
from lbt_synth.methods.method import Description, RowTable


def _describe(design: FusedFilter) -> Description:
    """Describe a filter of several sensors, and its loop when some fail."""
    plant = design.problem
    rows = failure_rows(plant, design.gains, design.fallbacks)
    unseen = [row.missing for row in rows if row.must_switch]
    notes = [
        "unseen: the readings are zero, or frozen, and the filter believes them: a reading that "
        "stays leaves an offset, which counts to the residual. Not read: the "
        "fall-back filter of this file for the remaining sensors, with the same state.",
    ]
    if unseen:
        notes.append(
            f"note: unstable if these fail unseen: {'; '.join(unseen)}. The computer of the loop "
            "has to see such a failure, and take the fall-back filter."
        )
    return Description(
        facts=design.facts(),
        tables=(RowTable(key="failures", title="When sensors fail", rows=rows),),
        notes=notes,
        matrices={"gains": design.gains},
    )


FUSED = FilterKind(describe=_describe, pack=record_fused, unpack=rebuild_fused)
