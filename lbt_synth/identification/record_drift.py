"""What is slower than a record: its offset and its drift.

The fit sees a drift in its lowest frequencies only, and an offset not at all. The filter sees both,
and what it does not reject at zero frequency stays in the residual for ever.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.loop import ClosedLoop
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray

_SHARE = 0.3  # of the residual


def note_drift(record: LoopRecord, loop: ClosedLoop, residual_nm: FloatArray) -> Iterator[str]:
    """Yield a note on each axis whose offset and drift leave much beside its residual (n,)."""
    series = record.pseudo_open_loop(np.diag(loop.hardware.sensor))[record.usable]
    seconds = np.flatnonzero(record.usable) / record.frame_rate_hz
    speed, mean = np.polyfit(seconds - np.mean(seconds), series, 1)
    away = np.abs(mean) + np.abs(speed) * np.ptp(seconds) / 2
    rejected = loop.rejection().frequency_response([0.0])[0].real
    for i, left in enumerate(np.abs(rejected) @ away):
        if left > _SHARE * residual_nm[i]:
            yield (
                f"axis {i} of the record stands {nm_text(mean[i])} off zero and drifts by "
                f"{nm_text(speed[i])}/s. The filter sees that, and leaves up to "
                f"{nm_text(left, '.2g')} of it. Offload it to the telescope"
            )
