"""Filters for intervals of vibration frequencies."""

from __future__ import annotations

import functools

from support.plants import lbt_axis_plant

import lbt_synth as lbt


@functools.cache
def interval_design(norm, half):
    return lbt.design.polytopic(lbt_axis_plant(), half_width_hz=half, norm=norm)


class IntervalDesigns:
    """Polytopic designs by norm and half width, each made when a test first asks for it."""

    def __getitem__(self, key):
        return interval_design(*key)


def predictor(design):
    """Filter from ybar to the next z, of a design with a gain."""
    return lbt.EstimationProblem.controller(design.problem, design.gain_predictor)
