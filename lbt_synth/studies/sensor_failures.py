"""A loop of several sensors in which some fail on the way, beside the exact answer of each time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.linear import Controller
from lbt_synth.loop import ClosedLoop, Imaging, Simulation, close_loop, residual_budget
from lbt_synth.loop.simulation.failing_sensors import (
    Drop,
    Segment,
    run_segments,
    simulate_sensors,
)
from lbt_synth.loop.strehl import series_strehl
from lbt_synth.models import LoopHardware, Truth
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FailureRun:
    """A run in which sensors fail."""

    simulation: Simulation
    segments: tuple[Segment, ...]  # times between failures and returns
    # exact stationary residual of each [nm rms]; nan where the loop is unstable, a frozen reading
    # adds an offset of its own, or a vibration of the truth drifts
    exact_nm: tuple[float, ...]
    stable: tuple[bool, ...]  # whether the loop of each is

    def rows(self, imaging: Imaging) -> list[SegmentRow]:
        """Return a row per segment."""
        rate, residual = self.simulation.frame_rate_hz, self.simulation.residual_nm
        out = []
        for segment, exact, stable in zip(self.segments, self.exact_nm, self.stable, strict=True):
            first, last = (int(np.ceil(t * rate - 1e-6)) for t in (segment.start_s, segment.end_s))
            part = residual[:, first:last]
            out.append(
                SegmentRow(
                    start_s=segment.start_s,
                    end_s=segment.end_s,
                    sensors=segment.text or "none",
                    residual_nm=float(np.sqrt(np.mean(np.sum(part**2, axis=2)))),
                    exact_nm=exact,
                    strehl=float(np.mean([series_strehl(case, imaging) for case in part]))
                    if stable
                    else np.nan,
                    stable=stable,
                )
            )
        return out


def run_failures(
    design: Design,
    config: Config,
    truth: Truth,
    drops: Sequence[Drop],
    *,
    frames: int,
    cases: int,
    seed: int,
) -> FailureRun:
    """Run the loop of a configuration in which sensors fail, none after the end of the run."""
    filters = design.controllers
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
    segments = run_segments(drops, frames / config.hardware.frame_rate_hz)
    loops = [_segment_loop(hardware, filters, truth, segment) for segment in segments]
    return FailureRun(
        simulation=simulation,
        segments=segments,
        exact_nm=tuple(
            np.nan
            if truth.drifts or "frozen" in segment.wrong.values() or not loop.is_stable
            else residual_budget(loop, truth, frame_means=True).rms_nm
            for segment, loop in zip(segments, loops, strict=True)
        ),
        stable=tuple(loop.is_stable for loop in loops),
    )


def _segment_loop(
    hardware: LoopHardware,
    filters: Mapping[frozenset[str], Controller],
    truth: Truth,
    segment: Segment,
) -> ClosedLoop:
    """Return the loop of a segment, with its filter."""
    return close_loop(
        hardware,
        filters[frozenset(segment.missing)],
        sensor_gain=truth.sensor_gain,
        blind=(*segment.missing, *segment.wrong),
    )
