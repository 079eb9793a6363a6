"""Resonances that both axes share, found by the joint likelihood of the axes.

Each axis has been identified alone. A resonance that shakes along a diagonal is then a line on
either axis, or on the one that shows it. Pairs of lines at the same frequency, and lines of one
axis that the other may show weakly, are fitted again as one line along a direction. So is
turbulence that the axes have in common, as a process along a direction beside what each axis has
of its own. What the likelihood does not ask for stays apart, and so does a line that moves on an
ellipse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lbt_synth.identification.fit.joint_whittle import (
    JointDensity,
    JointFit,
    JointPeriodogram,
    JointSearch,
    JointSpectrum,
    Tie,
    joint_contrast,
    joint_density,
)
from lbt_synth.identification.fit.physical_parameters import parameter_covariance, standard_errors
from lbt_synth.identification.fit.spectrum_model import Component, damping_parameter
from lbt_synth.identification.fit.whittle import FittedModel
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import ComplexArray, FloatArray

_APART = 4.0  # standard errors between frequencies that differ
_UNFITTED = 10.0  # log-likelihood that a fit may add to a line that the axes share
_COHERENT = 0.5  # squared coherence of lines that are worth a fit all the same
_ON_AXIS = 14.0  # logarithm of the powers of a line on both axes
_HARDLY = 2.0  # the same of a part that one axis alone does not show
_MOST_SHARED, _MOST_DAMPING = 0.95, 0.9  # of turbulence of both axes, to begin with
_LEAST_SHARE = 0.3  # of the turbulence in a density that says whether the axes share it
_HIGHEST_HZ = 10.0  # natural frequency of turbulence


class Place(NamedTuple):
    """A component of one of the axes."""

    axis: int
    part: int


def find_shared(
    search: JointSearch, models: Sequence[FittedModel]
) -> tuple[JointFit | None, list[float]]:
    """Return the joint fit of two axes with all that they share; None if that is nothing.

    The frequencies [Hz] of lines that move on ellipses follow.
    """
    first, second = models
    base = JointSpectrum(axes=(first.spectrum, second.spectrum))
    pairs = _find_pairs(search, models)
    fit, ellipses = _share_lines(search, base, pairs)
    made = _share_turbulence(search, base if fit is None else fit.joint)
    if made is None:
        return fit, ellipses
    # turbulence of both axes may look like weak parts of lines: these are sought again
    joint = made.joint
    for k in reversed(range(len(joint.ties) - 1)):
        joint = joint.untie(k)
    fit, ellipses = _share_lines(search, joint, pairs)
    return search.fit(joint) if fit is None else fit, ellipses


def _share_lines(
    search: JointSearch, joint: JointSpectrum, pairs: Sequence[tuple[Place, Place | None]]
) -> tuple[JointFit | None, list[float]]:
    """Return the fit with the lines that the axes share, and the frequencies of ellipses [Hz]."""
    fit = None
    while True:  # a line may come to light once a neighbour has its direction
        proposed, ellipses = _propose_ties(search, joint, pairs)
        more = _keep_asked(search, proposed) if len(proposed.ties) > len(joint.ties) else None
        if more is None or len(more.joint.ties) <= len(joint.ties):
            return fit, sorted(ellipses)
        fit, joint = more, more.joint


def _keep_asked(search: JointSearch, joint: JointSpectrum) -> JointFit | None:
    """Fit a model, and untie what the likelihood does not ask for; None if nothing is left."""
    while joint.ties:
        fit = _fit_directions(search, joint)
        if fit is None:
            return None
        spare = [_spare(search, fit, k) for k in range(len(joint.ties))]
        worst = int(np.argmin(spare))
        if spare[worst] > 0:
            return fit
        joint = fit.joint.untie(worst)
    return None


def _fit_directions(search: JointSearch, joint: JointSpectrum) -> JointFit | None:
    """Fit a model; None if no fit settles.

    A fit does not take a line across an axis: one that ends there begins again beyond it.
    """
    fit = search.fit(joint)
    if fit is None:
        return None

    def turn(tie: Tie) -> Tie:
        one, other = (c.components[i] for c, i in zip(fit.joint.axes, tie.parts, strict=True))
        on_axis = abs(one.log_power - other.log_power) > _ON_AXIS
        return replace(tie, phase=tie.phase + np.pi) if on_axis else tie

    ties = tuple(turn(tie) for tie in joint.ties)
    beyond = None if ties == joint.ties else search.fit(replace(joint, ties=ties))
    return fit if beyond is None or beyond.lost(fit.joint) < 0 else beyond


def _spare(search: JointSearch, fit: JointFit, k: int) -> float:
    """Return by how much tie k adds more to the log-likelihood than it must.

    Two lines have more parameters than one: it must add nothing. The part of an axis that had no
    line is one parameter. A line that would add as much by a free phase moves on an ellipse.
    """
    tie = fit.joint.ties[k]
    if fit.by_phase[k] > search.price:
        return -float(fit.by_phase[k])
    if None not in tie.before:
        return fit.lost(fit.joint.untie(k))
    one, other = (
        None if before is None else axis.components[part]
        for axis, part, before in zip(fit.joint.axes, tie.parts, tie.before, strict=True)
    )
    return fit.lost(fit.joint.release(k, (one, other))) - search.price


def _find_pairs(
    search: JointSearch, models: Sequence[FittedModel]
) -> list[tuple[Place, Place | None]]:
    """Return each resonance, the clearest first, and that of the other axis which may be the same.

    Its frequency agrees within errors, or the two overlap.
    """
    errors = [standard_errors(m.spectrum, parameter_covariance(m)).components for m in models]
    left = [Place(a, i) for a, m in enumerate(models) for i in range(1, len(m.spectrum.components))]
    left.sort(key=lambda at: -models[at.axis].evidence[at.part])

    def place(at: Place) -> tuple[float, float]:
        return search.searches[at.axis].place(models[at.axis].spectrum.components[at.part])

    pairs: list[tuple[Place, Place | None]] = []
    while left:
        strong = left.pop(0)
        centre, half = place(strong)
        near: list[tuple[float, Place]] = []
        for weak in left:
            its_centre, its_half = place(weak)
            one, other = (errors[axis][part].log_frequency for axis, part in (strong, weak))
            reach = max(_APART * centre * float(np.hypot(one, other)), 0.5 * (half + its_half))
            if weak.axis != strong.axis and abs(its_centre - centre) <= reach:
                near.append((abs(its_centre - centre), weak))
        partner = min(near)[1] if near else None
        if partner is not None:
            left.remove(partner)
        pairs.append((strong, partner))
    return pairs


def _propose_ties(
    search: JointSearch, joint: JointSpectrum, pairs: Sequence[tuple[Place, Place | None]]
) -> tuple[JointSpectrum, list[float]]:
    """Return the model with all lines that may be shared, and the frequencies of ellipses [Hz]."""
    from scipy.linalg import eigh

    data = search.merge(joint)
    density, alone = joint_density(data, joint), joint_contrast(data, joint)
    tied = {Place(a, part) for tie in joint.ties for a, part in enumerate(tie.parts)}
    out, ellipses = joint, list[float]()
    for strong, weak in pairs:
        if strong in tied or weak in tied:
            continue
        power, noise = _line_power(data, data.powers(joint), density, strong, weak)
        line, turning = eigh(power.real, noise.real)[1][:, -1], eigh(power, noise)[1][:, -1]
        straight = joint_contrast(data, _tie(joint, strong, weak, line)) - alone
        around = joint_contrast(data, _tie(joint, strong, weak, turning)) - alone
        if weak is None:
            worth_a_fit = straight < _HARDLY - search.price
        elif around < min(straight, 0.0) - _UNFITTED - search.price:
            worth_a_fit = False
            own = joint.axes[strong.axis].components[strong.part]
            ellipses.append(search.searches[strong.axis].place(own)[0])
        else:
            (first, crossed), (_, second) = power.real
            worth_a_fit = straight < _UNFITTED or crossed**2 > _COHERENT * first * second
        if worth_a_fit:
            out = _tie(out, strong, weak, line)
    return out, ellipses


def _line_power(
    data: JointPeriodogram,
    powers: tuple[FloatArray, FloatArray],
    density: JointDensity,
    strong: Place,
    weak: Place | None,
) -> tuple[ComplexArray, ComplexArray]:
    """Return the power of a line over the rest of the model, and that of the rest, (2, 2) each.

    Both are weighted by the inverse of the rest and by the line: the direction in which the first
    is largest over the second is that of the line. The axes have ``powers`` (f,).
    """
    own = np.zeros((2, data.crossed.size))
    for at in (strong, weak):
        if at is not None:
            own[at.axis] = density.parts[at.axis][1 + at.part]
    rest = density.diagonal - own
    seen = np.sum(own / rest, axis=0)
    core = np.max(own, axis=0) > 0.1 * np.max(own)
    weight = (data.axes[0].count * core * seen / (1 + seen))[:, None, None]
    whole = _hermitian(rest[0], rest[1], density.crossed)
    inverse = np.linalg.inv(whole)
    found = inverse @ (_hermitian(*powers, data.crossed) - whole) @ inverse
    return (
        np.sum(weight * found, axis=0),
        np.sum(weight * seen[:, None, None] * inverse, axis=0),
    )


def _hermitian(first: FloatArray, second: FloatArray, crossed: ComplexArray) -> ComplexArray:
    """Return matrices (f, 2, 2) of densities (f,)."""
    rows = [[first.astype(np.complex128), crossed], [crossed.conj(), second]]
    return np.moveaxis(np.array(rows), -1, 0)


def _tie(
    joint: JointSpectrum, strong: Place, weak: Place | None, line: NDArray[np.inexact]
) -> JointSpectrum:
    """Return the model with a line along a direction (2,), as large as on its strong axis."""
    other = 1 - strong.axis
    axes, own = list(joint.axes), joint.axes[strong.axis].components[strong.part]
    ratio = 2 * float(np.log(np.abs(line[other] / line[strong.axis])))
    share = replace(own.shift(0.0, 0.0, ratio), announced=None)
    before: list[Component | None] = [own, own]
    parts = [strong.part, strong.part]
    if weak is None:
        before[other], parts[other] = None, len(axes[other].components)
        axes[other] = axes[other].add(share)
    else:
        before[other], parts[other] = axes[other].components[weak.part], weak.part
        axes[other] = axes[other].exchange(weak.part, share)
    tie = Tie(
        parts=(parts[0], parts[1]),
        before=(before[0], before[1]),
        phase=float(np.angle(line[0] * np.conj(line[1]))),
    )
    return JointSpectrum(axes=(axes[0], axes[1]), ties=(*joint.ties, tie))


def _share_turbulence(search: JointSearch, alone: JointSpectrum) -> JointFit | None:
    """Return the fit with turbulence that the axes have in common; None if the model has enough.

    Its direction is that of the rms of the axes: beside turbulence of the same spectrum the data
    show no other.
    """
    data = search.merge(alone)
    density = joint_density(data, alone)
    first, second = density.diagonal
    share = np.sqrt(density.parts[0][1] / first * density.parts[1][1] / second)  # of turbulence
    share[share < _LEAST_SHARE] = 0
    count = data.axes[0].count
    weight = float(np.sum(count * share**2))
    crossed = data.crossed.real / np.sqrt(first * second)
    coherence = float(np.sum(count * share * crossed)) / weight if weight > 0 else 0.0
    if coherence**2 * weight < 0.5 * PARAMETERS * search.price:
        return None
    made = search.fit(_tie_turbulence(alone, coherence))
    if made is None or made.lost(alone) < PARAMETERS * search.price:
        return None
    tie = made.joint.ties[-1]
    centre, _ = search.searches[0].place(made.joint.axes[0].components[tie.parts[0]])
    return made if centre < _HIGHEST_HZ else None


def _tie_turbulence(joint: JointSpectrum, coherence: float) -> JointSpectrum:
    """Return the model with a part of its turbulence along a direction."""
    part = min(abs(coherence), _MOST_SHARED)
    own = [axis.components[0] for axis in joint.axes]
    ratio = min(float(np.sqrt(own[0].damping_ratio * own[1].damping_ratio)), _MOST_DAMPING)
    frequency = 0.5 * (own[0].log_frequency + own[1].log_frequency)
    damping = damping_parameter("slow", ratio)
    first, second = (
        axis.exchange(0, slow.shift(0.0, 0.0, float(np.log1p(-part)))).add(
            Component("slow", frequency, damping, slow.log_power + float(np.log(part)))
        )
        for axis, slow in zip(joint.axes, own, strict=True)
    )
    parts = len(first.components) - 1, len(second.components) - 1
    tie = Tie(parts=parts, phase=0.0 if coherence > 0 else float(np.pi), whole=True)
    return JointSpectrum(axes=(first, second), ties=(*joint.ties, tie))
