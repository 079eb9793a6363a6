"""A loop of several sensors in which some fail on the way, beside the exact answer of each time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design.fusion.fused_filter import FusedFilter
from lbt_synth.errors import UnstableLoopError
from lbt_synth.linear import PeriodicController
from lbt_synth.loop import Imaging, Simulation, residual_budget
from lbt_synth.loop.fusion.fused_loop import close_fused_loop
from lbt_synth.loop.fusion.simulation import Drop, Segment, run_segments, simulate_fused
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
        "exact, once settled", unit="nm rms", format=".2f", missing="unstable"
    )
    strehl: float = percent_column("Strehl")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FailureRun:
    """A run in which sensors fail."""

    simulation: Simulation
    segments: tuple[Segment, ...]  # times between failures and returns
    # exact stationary residual of each [nm rms]; nan where the loop is unstable, or a vibration
    # of the truth drifts
    exact_nm: tuple[float, ...]

    def rows(self, imaging: Imaging) -> list[SegmentRow]:
        """Return a row per segment."""
        rate, residual = self.simulation.frame_rate_hz, self.simulation.residual_nm
        out = []
        for segment, exact in zip(self.segments, self.exact_nm, strict=True):
            first, last = (int(np.ceil(t * rate - 1e-6)) for t in (segment.start_s, segment.end_s))
            part = residual[:, first:last]
            out.append(
                SegmentRow(
                    start_s=segment.start_s,
                    end_s=segment.end_s,
                    sensors=segment.text or "none",
                    residual_nm=float(np.sqrt(np.mean(np.sum(part**2, axis=2)))),
                    exact_nm=exact,
                    strehl=float(np.mean([series_strehl(case, imaging) for case in part])),
                )
            )
        return out


def run_failures(
    design: FusedFilter,
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
    simulation = simulate_fused(
        filters,
        design.problem.suite,
        truth,
        hardware=config.hardware,
        frames=frames,
        cases=cases,
        seed=seed,
        settle_frames=config.settings.simulation.settle_frames,
        drops=drops,
    )
    segments = run_segments(drops, frames / config.hardware.frame_rate_hz)
    exact = tuple(_exact_nm(design, filters, config, truth, segment) for segment in segments)
    return FailureRun(simulation=simulation, segments=segments, exact_nm=exact)


def _exact_nm(
    design: FusedFilter,
    filters: Mapping[frozenset[str], PeriodicController],
    config: Config,
    truth: Truth,
    segment: Segment,
) -> float:
    if truth.drifts:
        return np.nan
    loop = close_fused_loop(
        config.hardware,
        design.problem.suite,
        filters[frozenset(segment.missing)],
        sensor_gain=truth.sensor_gain,
        blind=(*segment.missing, *segment.wrong),
    )
    try:
        return residual_budget(loop, truth).rms_nm
    except UnstableLoopError:
        return np.nan
