"""What a frame of an exported controller costs, as facts and as data."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lbt_synth.cli.output import Facts
from lbt_synth.interop import FrameCost


def cost_facts(cost: FrameCost) -> Facts:
    """Return rows of a table: what a frame costs, and what it would cost with whole matrices."""
    return [
        ("multiplications per frame", cost.multiplications, f"({cost.form})"),
        ("  with whole matrices", cost.dense_multiplications, ""),
        ("additions per frame", cost.additions, ""),
        ("  with whole matrices", cost.dense_additions, ""),
        ("coefficients, double", cost.coefficient_bytes_double, "bytes"),
        ("coefficients, single", cost.coefficient_bytes_single, "bytes"),
        ("  with whole matrices, double", 8 * cost.dense_coefficients, "bytes"),
        ("state, double", cost.state_bytes_double, "bytes"),
        ("state, single", cost.state_bytes_single, "bytes"),
    ]


def cost_record(cost: FrameCost) -> dict[str, Any]:
    """Return the cost of a frame for JSON."""
    sizes = [f"{what}_bytes_{p}" for what in ("coefficient", "state") for p in ("double", "single")]
    return asdict(cost) | {name: getattr(cost, name) for name in sizes}
