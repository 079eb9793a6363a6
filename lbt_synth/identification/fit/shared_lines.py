"""Resonances that both axes share, found by the joint likelihood of the axes.

Each axis has been identified alone. A resonance that shakes along a diagonal is then a line on
either axis, or on the one that shows it. Pairs of resonances at the same frequency, and those of
one axis that the other may show weakly, are fitted again as one along a direction, the clearest
first. What costs more so than apart stays apart; so does a line that moves on an ellipse, which no
direction describes. The sensor gains are held: each axis has found its own before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    describe_axis,
    hold_gain,
)
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.spectrum_model import BACKGROUND, GAIN, Component, SpectrumModel
from lbt_synth.identification.fit.whittle import (
    EXACT,
    HOPE,
    FittedModel,
    contrast,
    invert_information,
    observe_information,
    part_densities,
    spectral_matrix,
)
from lbt_synth.identification.records.faults import SURPRISING
from lbt_synth.identification.records.record import LoopRecord, Stretches
from lbt_synth.models.resonance_spectrum import PARAMETERS

_MOST_SHARED = 0.9  # of the turbulence, where a fit begins

Pair = tuple[Component | None, Component | None]  # what is one resonance, on either axis


def couple_axes(
    record: LoopRecord, axes: Sequence[IdentifiedAxis], stretches: Stretches, lowest_line_hz: float
) -> tuple[list[IdentifiedAxis], tuple[IdentifiedLine, ...]]:
    """Return two axes with what they share, if they do, and the shared resonances."""
    data = loop_periodogram(
        record.measurements,
        record.corrections(),
        frame_rate_hz=record.frame_rate_hz,
        stretches=sorted(stretches),
    )
    search = Search(data=data, gain=axes[0].sensor_gain, lowest_line_hz=lowest_line_hz)
    model = find_shared(search, [axis.fitted_model for axis in axes])
    if model is None:
        return list(axes), ()
    model = observe_information(search.merge(model.spectrum), model, search.priors(model.spectrum))
    errors = [(axis.sensor_gain_error or 0.0) / axis.sensor_gain for axis in axes]
    one_gain = axes[0].sensor_gain == axes[1].sensor_gain
    groups = [([0, 1], errors[0])] if one_gain else [([i], errors[i]) for i in range(2)]
    model = hold_gain(search, model, groups)
    sizes = [_describe_size(model, k) for k in model.spectrum.shared]
    coupled = [_describe_axis(search, model, i, axis, sizes) for i, axis in enumerate(axes)]
    lines = []
    for size in sizes:
        shares = [p for axis in coupled for p in axis.parts if p.direction == size["direction"]]
        if shares:  # not of a resonance that has no power on either axis
            strongest = max(shares, key=lambda share: share.prominence)
            lines.append(replace(strongest, **size))
    return coupled, tuple(sorted(lines, key=lambda line: line.frequency_hz))


def find_shared(search: Search, models: Sequence[FittedModel]) -> FittedModel | None:
    """Return the joint fit of two axes with all that they share; None if that is nothing.

    Turbulence comes first: that of both axes may look like weak parts of lines.
    """
    parts = [(i, c) for i, model in enumerate(models) for c in model.spectrum.components]
    named = tuple(replace(c, axis=i, name=name) for name, (i, c) in enumerate(parts, start=1))
    apart = SpectrumModel(tuple(model.spectrum.background for model in models), named)
    pairs = _find_pairs(search, models, named)
    air = _share_turbulence(search, apart)
    if air is not None:
        model = _share_lines(search, air.spectrum, pairs) or air
        rest = contrast(search.data, model.spectrum.exchange(1))
        if rest - model.contrast > search.price:  # not what lines have in common
            return model
    return _share_lines(search, apart, pairs)


def _share_lines(
    search: Search, spectrum: SpectrumModel, pairs: Sequence[Pair]
) -> FittedModel | None:
    """Return the fit with all lines that the axes share, None without any."""
    model, least, before = None, contrast(search.data, spectrum), 0
    while len(pairs) != before:  # a line may come to light once a neighbour has its direction
        before = len(pairs)
        for pair in pairs:
            line = _share(search, spectrum, pair)
            trial = line and fitting.fit(search, _replace(spectrum, pair, line), accuracy=EXACT)
            # one parameter more than a resonance has, in the place of one or two
            saved = search.price * (1 - pair.count(None)) - search.parameter_price
            if trial and trial.contrast < least + saved:
                model, spectrum, least = trial, trial.spectrum, trial.contrast
                pairs = [waiting for waiting in pairs if waiting is not pair]
    return model


def _replace(spectrum: SpectrumModel, pair: Pair, shared: Component) -> SpectrumModel:
    """Return the model with a shared resonance in the place of a pair, as the last component."""
    names = {line.name for line in pair if line is not None}
    rest = tuple(c for c in spectrum.components if c.name not in names)
    return replace(spectrum, components=(*rest, shared))


def _find_common(
    data: LoopPeriodogram, spectrum: SpectrumModel, parts: Sequence[int]
) -> tuple[float, float]:
    """Return what axes have in common in components, and what that adds to the log-likelihood."""
    densities = part_densities(data, spectrum, [spectrum.components[i] for i in parts])
    # the excess of the cross-spectrum over the model's, by the geometric mean of both densities
    line, matrix = np.sqrt(densities[0] * densities[-1]), spectral_matrix(data, spectrum)
    weight = data.count * line / (matrix[0, 0] * matrix[1, 1])
    slope = float(np.sum(weight * (data.matrix(spectrum.gains)[0, 1] - matrix[0, 1])))
    bend = float(np.sum(weight * line))
    return slope / bend, slope**2 / bend


def _share_turbulence(search: Search, apart: SpectrumModel) -> FittedModel | None:
    """Return the fit with turbulence that the axes share beside their own; None if too little."""
    slow = [i for i, c in enumerate(apart.components) if c.kind == "turbulence"]
    coherence, evidence = _find_common(search.merge(apart), apart, slow)
    if evidence < search.price:
        return None
    common = min(abs(coherence), _MOST_SHARED)
    first, second = (apart.components[i] for i in slow)
    log_rest = float(np.log1p(-common))
    components = [
        c.shift(0.0, 0.0, log_rest) if c.kind == "turbulence" else c for c in apart.components
    ]
    shared = replace(  # along the rms of the axes: beside turbulence, data show no other direction
        first.shift(0.0, 0.0, float(np.log(common))),
        kind="slow",
        axis=None,
        log_ratio=second.log_power - first.log_power,
        sign=1.0 if coherence > 0 else -1.0,
    )
    spectrum = replace(apart, components=(*components[:1], shared, *components[1:]))
    return fitting.fit(search, spectrum, accuracy=EXACT)


def _find_pairs(
    search: Search, models: Sequence[FittedModel], components: Sequence[Component]
) -> list[Pair]:
    """Return each resonance, the clearest first, and the one of the other axis it may be."""
    evidence = chain(*(model.evidence for model in models))
    errors = chain(*(model.errors.components for model in models))
    rows = [
        (worth, c, error.log_frequency)
        for worth, c, error in zip(evidence, components, errors, strict=True)
        if c.kind == "line"
    ]
    rows.sort(key=lambda row: -row[0])
    pairs: list[Pair] = []
    while rows:
        _, strong, error = rows.pop(0)
        centre, half = search.place(strong)
        distances = {}
        for _, rival, its_error in rows:
            its_centre, its_half = search.place(rival)
            uncertain = SURPRISING * centre * float(np.hypot(error, its_error))
            apart = abs(its_centre - centre)
            if rival.axis != strong.axis and apart <= max(uncertain, 0.5 * (half + its_half)):
                distances[rival] = apart
        partner = min(distances, key=distances.__getitem__, default=None)
        rows = [row for row in rows if row[1] is not partner]
        pairs.append((strong, partner) if strong.axis == 0 else (partner, strong))
    return pairs


def _share(search: Search, spectrum: SpectrumModel, pair: Pair) -> Component | None:
    """Return a resonance along a direction in the place of a pair; None where it adds little."""
    names = [None if c is None else c.name for c in pair]
    places = [i for i, c in enumerate(spectrum.components) if c.name in names]
    data = search.merge(spectrum)
    common, evidence = _find_common(data, spectrum, places)
    if evidence < search.parameter_price:
        return None
    members = [spectrum.components[i] for i in places]
    strong = max(members, key=lambda c: c.log_power)
    ratio = 2 * float(np.log(abs(common))) * (-1 if pair[0] is None else 1)
    if len(members) > 1:
        ratio = members[1].log_power - members[0].log_power
    shared = replace(
        strong,
        axis=None,
        log_power=members[0].log_power - ratio * (pair[0] is None),
        log_ratio=ratio,
        sign=1.0 if common >= 0 else -1.0,
    )
    lost = contrast(data, _replace(spectrum, pair, shared)) - contrast(data, spectrum)
    return shared if lost < HOPE * evidence else None


def _describe_axis(
    search: Search,
    model: FittedModel,
    i: int,
    alone: IdentifiedAxis,
    sizes: Sequence[dict[str, Any]],
) -> IdentifiedAxis:
    """Return axis i of a joint fit in the units of the phase."""
    spectrum, data = model.spectrum, search.merge(model.spectrum)
    theta, seen = spectrum.pack(), spectrum.on(i)
    # the derivatives of the parameters of what the axis shows by all, which are constant
    moved = [spectrum.unpack(theta + step).on(i).pack() for step in np.eye(theta.size)]
    rows = np.transpose(moved - seen.pack())
    order = [k for k, c in enumerate(spectrum.components) if c.axis == i][1:]
    order += spectrum.shared
    joint = contrast(data, spectrum)
    evidence = [contrast(data, spectrum.exchange(k)) - joint for k in order]
    shown = FittedModel(
        spectrum=seen,
        contrast=contrast(alone.data, seen),
        # with the other axis left open
        information=invert_information(rows @ model.covariance @ rows.T),
        evidence=(float("inf"), *evidence),
    )
    error = alone.sensor_gain_error
    return describe_axis(
        replace(search, data=alone.data, gain=alone.sensor_gain),
        shown,
        None if error is None else error / alone.sensor_gain,
        alone.sensor_gain_note,
        directions=[(size["direction"], size["direction_error_deg"]) for size in sizes],
    )


def _describe_size(model: FittedModel, k: int) -> dict[str, Any]:
    """Return the size and the direction of the shared resonance k, with their errors."""
    spectrum, c = model.spectrum, model.spectrum.components[k]
    sizes = np.exp(0.5 * (c.log_power + np.array([0.0, c.log_ratio]))) / spectrum.gains
    rows = np.zeros((2, len(model.information)))  # of the logarithms of both sizes
    power = spectrum.place(k) + PARAMETERS - 1
    rows[:, power], rows[1, power + 1] = 0.5, 0.5
    rows[[0, 1], [GAIN, BACKGROUND + GAIN]] = -1.0
    rms = float(np.hypot(*sizes))
    along = np.array([1.0, c.sign]) * sizes / rms
    logs = rows @ model.covariance @ rows.T
    square, turn = along**2, along[0] * along[1] * np.array([-1.0, 1.0])
    error = float(np.degrees(np.sqrt(max(turn @ logs @ turn, 0.0))))
    return {
        "rms_nm": rms,
        "rms_error_nm": rms * float(np.sqrt(square @ logs @ square)),
        "direction": (float(along[0]), float(along[1])),
        "direction_error_deg": error if c.kind == "line" else None,
    }
