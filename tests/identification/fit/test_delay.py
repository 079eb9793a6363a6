"""A wrong delay is found out."""

from __future__ import annotations

import pytest
from support.recorded_loops import LINE, spliced_record

import lbt_synth as lbt


@pytest.mark.parametrize("delay", [1.0, 2.5, 3.0])
def test_a_wrong_delay_is_noted(delay: float) -> None:
    record = spliced_record(lines=LINE, frames=30_000).with_delay(delay)
    found = lbt.identify(record)
    better = [note for note in found.notes if "fits better than" in note]
    if delay != 2.5:
        assert f"a delay of 2 frames fits better than {delay:g}" in better[0]
    assert found.notes or not found.axes[0].whiteness.white
