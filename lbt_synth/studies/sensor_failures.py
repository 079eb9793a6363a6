"""A loop of several sensors in which some fail on the way, beside the exact answer of each time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.loop import Simulation, close_loop, residual_budget
from lbt_synth.loop.simulation.failing_sensors import (
    Drop,
    Segment,
    run_segments,
    simulate_sensors,
)
from lbt_synth.loop.strehl import series_strehl
from lbt_synth.models import Truth
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row


@table_row
class SegmentRow:
    """The residual between two events."""

    start_s: float = column("from", unit="s", format="g")
    end_s: float = column("to", unit="s", format="g")
    sensors: str = column("sensors that fail")
    residual_nm: float = nm_column("simulated", unit="nm rms", format=".2f")
    exact_nm: float = nm_column(
        "exact, once settled",
        unit="nm rms",
        format=".2f",
        help="nan where the loop is unstable, a reading is frozen, or a vibration drifts",
    )
    strehl: float = percent_column("Strehl", help="nan where the loop is unstable")
    stable: bool = column("stable", help="Whether the loop is stable with these sensors")


def run_failures(
    design: Design,
    config: Config,
    truth: Truth,
    drops: Sequence[Drop],
    *,
    frames: int,
    cases: int,
    seed: int,
) -> tuple[Simulation, list[tuple[Segment, SegmentRow]]]:
    """Run the loop of a configuration in which sensors fail, none after the end of the run.

    Between failures and returns there is a segment, with a row that has its exact residual, too.
    """
    filters, rate = design.controllers, config.hardware.frame_rate_hz
    hardware = replace(config.hardware, suite=require_hardware(design, "a run").suite)
    simulation = simulate_sensors(
        filters,
        truth,
        hardware=hardware,
        frames=frames,
        cases=cases,
        seed=seed,
        settle_frames=config.settings.simulation.settle_frames,
        drops=drops,
    )
    rows = []
    for segment in run_segments(drops, frames / rate):
        loop = close_loop(
            hardware,
            filters[frozenset(segment.missing)],
            sensor_gain=truth.sensor_gain,
            blind=(*segment.missing, *segment.wrong),
        )
        # a frozen reading adds an offset of its own
        exact = loop.is_stable and not truth.drifts and "frozen" not in segment.wrong.values()
        first, last = (int(np.ceil(t * rate - 1e-6)) for t in (segment.start_s, segment.end_s))
        residual = simulation.residual_nm[:, first:last]
        strehls = [series_strehl(case, config.imaging) for case in residual if loop.is_stable]
        row = SegmentRow(
            start_s=segment.start_s,
            end_s=segment.end_s,
            sensors=segment.text or "none",
            residual_nm=float(np.sqrt(np.mean(np.sum(residual**2, axis=2)))),
            exact_nm=residual_budget(loop, truth).rms_nm if exact else np.nan,
            strehl=float(np.mean(strehls)) if strehls else np.nan,
            stable=loop.is_stable,
        )
        rows.append((segment, row))
    return simulation, rows
