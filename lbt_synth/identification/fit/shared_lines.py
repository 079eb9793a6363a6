"""Resonances that both axes share, found by the joint likelihood of the axes.

Each axis has been identified alone. A resonance that shakes along a diagonal is then a line on
either axis, or on the one that shows it. Pairs of lines at the same frequency, and lines of one
axis that the other may show weakly, are fitted again as one line along a direction. So is
turbulence that the axes have in common, as a process along a direction beside what each axis has
of its own. What the likelihood does not ask for stays apart, and so does a line that moves on an
ellipse. The sensor gains are held: each axis has found its own before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedLine
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.physical_parameters import (
    describe_axis,
    gain_covariance,
    standard_errors,
)
from lbt_synth.identification.fit.scoring import EXACT
from lbt_synth.identification.fit.spectrum_model import (
    GAIN,
    SHARED,
    Component,
    Spectra,
    damping_parameter,
)
from lbt_synth.identification.fit.whittle import (
    FittedModel,
    contrast,
    derivatives,
    invert_information,
    joint_density,
    observe_information,
    part_density,
)
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import ComplexArray, FloatArray

_APART = 4.0  # standard errors between frequencies that differ
_UNFITTED = 10.0  # log-likelihood that a fit may add to a line that the axes share
_COHERENT = 0.5  # squared coherence of lines that are worth a fit all the same
_ON_AXIS = 14.0  # logarithm of the powers of a line on both axes
_HARDLY = 2.0  # log-likelihood that a part that one axis alone does not show adds before a fit
_MOST_SHARED, _MOST_DAMPING = 0.95, 0.9  # of turbulence of both axes, to begin with
_LEAST_SHARE = 0.3  # of the turbulence in a density that says whether the axes share it
_HIGHEST_HZ = 10.0  # natural frequency of turbulence

Pair = tuple[int, int | None]  # names of a component, and of that of the other axis if there is one


def couple_axes(
    record: LoopRecord, axes: Sequence[IdentifiedAxis], stretches: Stretches, lowest_line_hz: float
) -> tuple[list[IdentifiedAxis], tuple[IdentifiedLine, ...], list[str]]:
    """Return two axes with what they share, the shared resonances, and notes.

    Axes that share nothing are returned as they are.
    """
    data = loop_periodogram(
        record.measurements,
        record.corrections(),
        frame_rate_hz=record.frame_rate_hz,
        stretches=sorted(stretches),
    )
    search = Search(data=data, gain=axes[0].sensor_gain, lowest_line_hz=lowest_line_hz)
    fit, ellipses = find_shared(search, [axis.fitted_model for axis in axes])
    notes = [
        f"the lines of both axes at {frequency:.4g} Hz move on an ellipse, with a phase between "
        "the axes: they stay two lines"
        for frequency in ellipses
    ]
    if fit is None:
        return list(axes), (), notes
    fit = _fit(search, fit.spectra) or fit  # on the frequencies that it needs
    fit = observe_information(search.merge(fit.spectra), fit, search.priors(fit.spectra))
    errors = [(axis.sensor_gain_error or 0.0) / axis.sensor_gain for axis in axes]
    one_gain = axes[0].sensor_gain == axes[1].sensor_gain
    groups = [([0, 1], errors[0])] if one_gain else [([i], errors[i]) for i in range(2)]
    covariance = gain_covariance(search, fit, groups)
    coupled = [_describe_axis(search, fit, covariance, i, axis) for i, axis in enumerate(axes)]
    parts, shared = [list(axis.parts) for axis in coupled], []
    for k, resonance in enumerate(fit.spectra.shared):
        places = [_find_part(axis, resonance) for axis in coupled]
        shares = [own[place] for own, place in zip(parts, places, strict=True)]
        line = _describe_line(fit.spectra, covariance, k, shares)
        for own, place, share in zip(parts, places, shares, strict=True):
            own[place] = replace(
                share, direction=line.direction, direction_error_deg=line.direction_error_deg
            )
        shared.append(line)
    shared.sort(key=lambda line: line.frequency_hz)
    each = zip(coupled, parts, strict=True)
    return [replace(axis, parts=tuple(own)) for axis, own in each], tuple(shared), notes


def _describe_axis(
    search: Search, fit: FittedModel, covariance: FloatArray, i: int, alone: IdentifiedAxis
) -> IdentifiedAxis:
    """Return axis i of a joint fit in the units of the phase."""
    spectra, own = fit.spectra, fit.spectra.axes[i]
    less = [spectra.on_axis(i, own.exchange(k)) for k in range(1, len(own.components))]
    less += [spectra.release(k) for k in range(len(spectra.shared))]
    whole, rows = spectra.whole(i), spectra.axis_map(i)
    model = FittedModel(
        spectra=Spectra((whole,)),
        contrast=contrast(alone.data, whole),
        information=invert_information(rows @ covariance @ rows.T),  # the other axis left open
        evidence=(float("inf"), *(_lost(search, fit, other) for other in less)),
    )
    error = alone.sensor_gain_error
    return describe_axis(
        replace(search, data=alone.data, gain=alone.sensor_gain),
        model,
        None if error is None else error / alone.sensor_gain,
        alone.sensor_gain_note,
        shared=range(len(own.components), len(whole.components)),
    )


def _find_part(axis: IdentifiedAxis, component: Component) -> int:
    """Return which of the parts of an axis a component is."""
    frequency_hz = component.frequency / axis.data.angle_s
    apart = [abs(part.frequency_hz - frequency_hz) for part in axis.parts]
    return int(np.argmin(apart))


def _describe_line(
    spectra: Spectra, covariance: FloatArray, k: int, shares: Sequence[IdentifiedLine]
) -> IdentifiedLine:
    """Return shared resonance k, with its size along its direction, from its shares."""
    resonance = spectra.shared[k]
    first, second = (share.rms_nm for share in shares)
    rms = float(np.hypot(first, second))
    along = np.array([first, second * np.sign(np.cos(resonance.phase))]) / rms
    power = spectra.starts[-1] + SHARED * k + PARAMETERS - 1
    slope = np.zeros((2, len(covariance)))  # of the logarithms of both rms
    slope[:, power] = slope[1, power + 1] = 0.5
    slope[[0, 1], [start + GAIN for start in spectra.starts[:-1]]] = -1.0
    logs = slope @ covariance @ slope.T
    size, turn = along**2, along[0] * along[1] * np.array([-1.0, 1.0])
    error = float(np.degrees(np.sqrt(max(turn @ logs @ turn, 0.0))))
    return replace(
        max(shares, key=lambda share: share.prominence),
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(size @ logs @ size)),
        announced=any(share.announced for share in shares),
        direction=(float(along[0]), float(along[1])),
        direction_error_deg=None if resonance.holds_ratio else error,
    )


def find_shared(
    search: Search, models: Sequence[FittedModel]
) -> tuple[FittedModel | None, list[float]]:
    """Return the joint fit of two axes with all that they share; None if that is nothing.

    The frequencies [Hz] of lines that move on ellipses follow.
    """
    names = count(1)
    spectra = Spectra(
        tuple(
            replace(
                m.spectrum,
                components=tuple(replace(c, name=next(names)) for c in m.spectrum.components),
            )
            for m in models
        )
    )
    pairs = _find_pairs(search, spectra, models)
    fit, ellipses = _share_lines(search, spectra, pairs)
    made = _share_turbulence(search, spectra if fit is None else fit.spectra)
    if made is None:
        return fit, ellipses
    # turbulence of both axes may look like weak parts of lines: these are sought again
    spectra = made.spectra
    for k in reversed(range(len(spectra.shared) - 1)):
        spectra = spectra.release(k, *spectra.shared[k].before)
    fit, ellipses = _share_lines(search, spectra, pairs)
    return _fit(search, spectra) if fit is None else fit, ellipses


def _fit(search: Search, spectra: Spectra) -> FittedModel | None:
    """Fit all parameters but gains and phases; None if no fit settles."""
    return fitting.fit(search, spectra, accuracy=EXACT)


def _lost(search: Search, fit: FittedModel, other: Spectra) -> float:
    """Return by how much another model is less likely than a fit, without the priors."""
    return contrast(search.merge(fit.spectra), other) - fit.contrast


def _share_lines(
    search: Search, spectra: Spectra, pairs: Sequence[Pair]
) -> tuple[FittedModel | None, list[float]]:
    """Return the fit with the lines that the axes share, and the frequencies of ellipses [Hz]."""
    fit = None
    while True:  # a line may come to light once a neighbour has its direction
        proposed, ellipses = _propose_shared(search, spectra, pairs)
        is_more = len(proposed.shared) > len(spectra.shared)
        more = _keep_asked(search, proposed) if is_more else None
        if more is None or len(more.spectra.shared) <= len(spectra.shared):
            return fit, sorted(ellipses)
        fit, spectra = more, more.spectra


def _keep_asked(search: Search, spectra: Spectra) -> FittedModel | None:
    """Fit a model, and release what the likelihood does not ask for; None if nothing is left."""
    while spectra.shared:
        fit = _fit_directions(search, spectra)
        if fit is None:
            return None
        by_phase = _gains_by_phase(search, fit)
        spare = [_spare(search, fit, k, gain) for k, gain in enumerate(by_phase.tolist())]
        worst = int(np.argmin(spare))
        if spare[worst] > 0:
            return fit
        spectra = fit.spectra.release(worst, *fit.spectra.shared[worst].before)
    return None


def _fit_directions(search: Search, spectra: Spectra) -> FittedModel | None:
    """Fit a model; None if no fit settles.

    A fit does not take a line across an axis: one that ends there begins again beyond it.
    """
    fit = _fit(search, spectra)
    if fit is None:
        return None
    turned = tuple(
        replace(c, phase=c.phase + np.pi) if abs(c.log_ratio) > _ON_AXIS else c
        for c in fit.spectra.shared
    )
    if turned == fit.spectra.shared:
        return fit
    beyond = _fit(search, replace(fit.spectra, shared=turned))
    return fit if beyond is None or _lost(search, fit, beyond.spectra) > 0 else beyond


def _gains_by_phase(search: Search, fit: FittedModel) -> FloatArray:
    """Return what a free phase of each shared resonance would add to the log-likelihood, (k,)."""
    spectra = fit.spectra
    _, slope, information = derivatives(search.merge(spectra), spectra)
    free = search.priors(spectra).free
    phases = spectra.starts[-1] + SHARED * np.arange(1, 1 + len(spectra.shared)) - 1
    moving = np.append(free, phases)
    score = invert_information(information[np.ix_(moving, moving)])[free.size :, free.size :]
    return np.asarray(0.5 * slope[phases] ** 2 * np.diag(score))


def _spare(search: Search, fit: FittedModel, k: int, by_phase: float) -> float:
    """Return by how much shared resonance k adds more to the log-likelihood than it must.

    Two lines have more parameters than one: it must add nothing. The part of an axis that had no
    line is one parameter. A line that would add as much by a free phase moves on an ellipse.
    """
    resonance, price = fit.spectra.shared[k], search.price / PARAMETERS
    if by_phase > price:
        return -by_phase
    if None not in resonance.before:
        return _lost(search, fit, fit.spectra.release(k, *resonance.before))
    alone = [
        None if before is None else resonance.on(i) for i, before in enumerate(resonance.before)
    ]
    return _lost(search, fit, fit.spectra.release(k, *alone)) - price


def _find_pairs(search: Search, spectra: Spectra, models: Sequence[FittedModel]) -> list[Pair]:
    """Return each resonance, the clearest first, and that of the other axis which may be the same.

    Its frequency agrees within errors, or the two overlap.
    """
    rest: list[tuple[float, int, Component, float]] = []
    for axis, model in enumerate(models):
        errors = standard_errors(model.spectrum, model.covariance).components
        each = zip(spectra.axes[axis].components, model.evidence, errors, strict=True)
        rest += [(-worth, axis, c, error.log_frequency) for c, worth, error in each][1:]
    rest.sort(key=lambda row: row[0])
    pairs: list[Pair] = []
    while rest:
        _, axis, strong, error = rest.pop(0)
        centre, half = search.place(strong)
        near = {}
        for row in rest:
            its_centre, its_half = search.place(row[2])
            reach = max(_APART * centre * float(np.hypot(error, row[3])), 0.5 * (half + its_half))
            if row[1] != axis and abs(its_centre - centre) <= reach:
                near[row[2].name] = abs(its_centre - centre)
        partner = min(near, key=near.__getitem__, default=None)
        rest = [row for row in rest if row[2].name != partner]
        pairs.append((strong.name, partner))
    return pairs


def _propose_shared(
    search: Search, spectra: Spectra, pairs: Sequence[Pair]
) -> tuple[Spectra, list[float]]:
    """Return the model with all lines that may be shared, and the frequencies of ellipses [Hz]."""
    from scipy.linalg import eigh

    data = search.merge(spectra)
    density, alone = joint_density(data, spectra), contrast(data, spectra)
    price = search.price / PARAMETERS
    parts = {c.name: (i, c) for i, axis in enumerate(spectra.axes) for c in axis.components}
    out, ellipses = spectra, list[float]()
    for strong, weak in pairs:
        if strong not in parts or (weak is not None and weak not in parts):
            continue  # it is shared already
        own = np.zeros((2, data.count.size))
        for name in (strong, weak):
            if name is not None:
                i, component = parts[name]
                own[i] = part_density(data, spectra.axes[i], component)
        power, noise = _line_power(data, spectra.gains, density, own)
        line, turning = eigh(power.real, noise.real)[1][:, -1], eigh(power, noise)[1][:, -1]
        straight = contrast(data, _share(spectra, strong, weak, line)) - alone
        around = contrast(data, _share(spectra, strong, weak, turning)) - alone
        if weak is None:
            worth_a_fit = straight < _HARDLY - price
        elif around < min(straight, 0.0) - _UNFITTED - price:
            worth_a_fit = False
            ellipses.append(search.place(parts[strong][1])[0])
        else:
            (first, crossed), (_, second) = power.real
            worth_a_fit = straight < _UNFITTED or crossed**2 > _COHERENT * first * second
        if worth_a_fit:
            out = _share(out, strong, weak, line)
    return out, ellipses


def _line_power(
    data: LoopPeriodogram,
    gains: FloatArray,
    density: tuple[FloatArray, FloatArray, ComplexArray],
    own: FloatArray,
) -> tuple[ComplexArray, ComplexArray]:
    """Return the power of a line over the rest of the model, and that of the rest, (2, 2) each.

    Both are weighted by the inverse of the rest and by the line, whose density on either axis is
    ``own`` (2, f): the direction in which the first is largest over the second is that of the line.
    """
    *diagonal, crossed = density
    rest = np.array(diagonal) - own
    seen = np.sum(own / rest, axis=0)
    core = np.max(own, axis=0) > 0.1 * np.max(own)
    weight = (data.count * core * seen / (1 + seen))[:, None, None]
    whole = _hermitian(rest[0], rest[1], crossed)
    inverse = np.linalg.inv(whole)
    left, right = data.power(gains[:, None])
    measured = _hermitian(left, right, data.cross_power(gains.tolist())[0])
    excess = inverse @ (measured - whole) @ inverse
    return (
        np.sum(weight * excess, axis=0),
        np.sum(weight * seen[:, None, None] * inverse, axis=0),
    )


def _hermitian(first: FloatArray, second: FloatArray, crossed: ComplexArray) -> ComplexArray:
    """Return matrices (f, 2, 2) of densities (f,)."""
    rows = [[first.astype(np.complex128), crossed], [crossed.conj(), second]]
    return np.moveaxis(np.array(rows), -1, 0)


def _share(spectra: Spectra, strong: int, weak: int | None, line: NDArray[np.inexact]) -> Spectra:
    """Return the model with a line along a direction (2,), as large as on its strong axis."""
    before: list[Component | None] = [None, None]
    for i, axis in enumerate(spectra.axes):
        for place, component in enumerate(axis.components):
            if component.name in (strong, weak):
                before[i] = component
                spectra = spectra.on_axis(i, axis.exchange(place))
    own, on = next((c, i) for i, c in enumerate(before) if c is not None and c.name == strong)
    ratio = 2 * float(np.log(np.abs(line[1] / line[0])))
    resonance = Component(
        own.kind,
        own.log_frequency,
        own.damping,
        own.log_power - on * ratio,
        own.announced,
        log_ratio=ratio,
        phase=float(np.angle(line[0] * np.conj(line[1]))),
        before=(before[0], before[1]),
    )
    return replace(spectra, shared=(*spectra.shared, resonance))


def _share_turbulence(search: Search, alone: Spectra) -> FittedModel | None:
    """Return the fit with turbulence that the axes have in common; None if the model has enough.

    Its direction is that of the rms of the axes: beside turbulence of the same spectrum the data
    show no other.
    """
    data = search.merge(alone)
    first, second, _ = joint_density(data, alone)
    slow = [part_density(data, axis, axis.components[0]) for axis in alone.axes]
    share = np.sqrt(slow[0] / first * slow[1] / second)  # of turbulence
    share[share < _LEAST_SHARE] = 0
    weight = float(np.sum(data.count * share**2))
    crossed = data.cross_power(alone.gains.tolist())[0].real / np.sqrt(first * second)
    coherence = float(np.sum(data.count * share * crossed)) / weight if weight > 0 else 0.0
    if coherence**2 * weight < 0.5 * search.price:
        return None
    made = _fit(search, _with_shared_turbulence(alone, coherence))
    if made is None or _lost(search, made, alone) < search.price:
        return None
    return made if search.place(made.spectra.shared[-1])[0] < _HIGHEST_HZ else None


def _with_shared_turbulence(spectra: Spectra, coherence: float) -> Spectra:
    """Return the model with a part of its turbulence along a direction."""
    part = min(abs(coherence), _MOST_SHARED)
    own = [axis.components[0] for axis in spectra.axes]
    ratio = min(float(np.sqrt(own[0].damping_ratio * own[1].damping_ratio)), _MOST_DAMPING)
    less = float(np.log1p(-part))
    for i, (axis, slow) in enumerate(zip(spectra.axes, own, strict=True)):
        spectra = spectra.on_axis(i, axis.exchange(0, slow.shift(0.0, 0.0, less)))
    resonance = Component(
        "slow",
        0.5 * (own[0].log_frequency + own[1].log_frequency),
        damping_parameter("slow", ratio),
        own[0].log_power + float(np.log(part)),
        log_ratio=own[1].log_power - own[0].log_power,
        phase=0.0 if coherence > 0 else float(np.pi),
        holds_ratio=True,
    )
    return replace(spectra, shared=(*spectra.shared, resonance))
