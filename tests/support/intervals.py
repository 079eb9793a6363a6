"""Filters for intervals of vibration frequencies."""

from __future__ import annotations

import functools

from support.plants import lbt_axis_plant

import lbt_synth as lbt


@functools.cache
def interval_designs():
    """Polytopic designs by norm and half width."""
    plant = lbt_axis_plant()
    return {
        (norm, half): lbt.design.polytopic(plant, half_width_hz=half, norm=norm)
        for norm in ("hinf", "h2")
        for half in (0.0, 0.2, 1.0, 2.0)
    }


def predictor(design):
    """Filter from ybar to the next z, of a design with a gain."""
    return lbt.EstimationProblem.controller(design.problem, design.gain_predictor)
