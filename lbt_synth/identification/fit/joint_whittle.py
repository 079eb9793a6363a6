"""Whittle's likelihood of two axes that move together in some resonances.

For the cross-periodogram I (2, 2) of two series and their spectrum S (2, 2), both Hermitian::

    L = sum count (log det S + tr(S^-1 I))

is minus the logarithm of the likelihood. Each axis keeps its spectrum; a *tie* makes a component
of one and a component of the other the same resonance: one frequency, one damping ratio, a power
on each axis, and the cross-spectrum ``sqrt(S1 S2) e^(i phase)``. With a phase of 0 or pi the
resonance moves along a line, with any other on an ellipse. The sensor gains are fixed: each axis
has found its own before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.scoring import Priors, scoring_minimum
from lbt_synth.identification.fit.spectrum_model import COMPONENTS, Component, SpectrumModel
from lbt_synth.identification.fit.whittle import densities, invert_information, log_slopes
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_DIFFERENCE = 1e-4  # of a logarithm

Parts = tuple[Component | None, Component | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tie:
    """Components of both axes that are one resonance."""

    parts: tuple[int, int]  # their places
    before: Parts = (None, None)  # what they were when each axis had its own
    whole: bool = False  # whether the ratio of the powers is fixed, too
    phase: float = 0.0  # by which the first axis is ahead


@dataclass(frozen=True, slots=True, kw_only=True)
class JointSpectrum:
    """The spectra of two axes, and the resonances that they share."""

    axes: tuple[SpectrumModel, SpectrumModel]
    ties: tuple[Tie, ...] = ()

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of parameters of each axis."""
        first, second = (COMPONENTS + PARAMETERS * len(axis.components) for axis in self.axes)
        return first, second

    @property
    def starts(self) -> tuple[int, int]:
        """Where the parameters of each axis begin in the vector."""
        return 0, self.sizes[0]

    def place(self, axis: int, part: int) -> int:
        """Return where the parameters of a component begin in the vector."""
        return self.starts[axis] + COMPONENTS + PARAMETERS * part

    def pack(self) -> FloatArray:
        """Return the parameters of both axes, and the phases, as a vector (p,)."""
        phases = [tie.phase for tie in self.ties]
        return np.concatenate([*(axis.pack() for axis in self.axes), phases])

    def unpack(self, vector: FloatArray) -> JointSpectrum:
        """Return the model with the numbers of a vector (p,)."""
        one, other, phases = np.split(vector, np.cumsum(self.sizes))
        ties = zip(self.ties, phases.tolist(), strict=True)
        return JointSpectrum(
            axes=(self.axes[0].unpack(one), self.axes[1].unpack(other)),
            ties=tuple(replace(tie, phase=phase) for tie, phase in ties),
        )

    def columns(self) -> IntArray:
        """Return the place among the distinct parameters of each of the vector, (p,)."""
        owner = np.arange(sum(self.sizes) + len(self.ties))
        for tie in self.ties:
            i, j = (self.place(axis, part) for axis, part in enumerate(tie.parts))
            count = PARAMETERS if tie.whole else PARAMETERS - 1  # the power comes last
            owner[j : j + count] = owner[i : i + count]
        return np.asarray(np.unique(owner, return_inverse=True)[1])

    def release(self, k: int, parts: Parts) -> JointSpectrum:
        """Return the model with separate components, or none, in the place of tie k."""
        axes, ties = list(self.axes), list(self.ties)
        tie = ties.pop(k)
        for axis, (place, part) in enumerate(zip(tie.parts, parts, strict=True)):
            axes[axis] = axes[axis].exchange(place, *(() if part is None else (part,)))
            if part is None:
                ties = [_move_down(other, axis, place) for other in ties]
        return JointSpectrum(axes=(axes[0], axes[1]), ties=tuple(ties))

    def untie(self, k: int) -> JointSpectrum:
        """Return the model with what tie k has replaced."""
        return self.release(k, self.ties[k].before)

    def drop(self, axis: int, place: int) -> JointSpectrum:
        """Return the model without a component, on both axes if it is tied."""
        for k, tie in enumerate(self.ties):
            if tie.parts[axis] == place:
                return self.release(k, (None, None))
        axes = list(self.axes)
        axes[axis] = axes[axis].exchange(place)
        ties = tuple(_move_down(tie, axis, place) for tie in self.ties)
        return JointSpectrum(axes=(axes[0], axes[1]), ties=ties)


def _move_down(tie: Tie, axis: int, place: int) -> Tie:
    """Return a tie after a component of an axis has left its place."""
    parts = list(tie.parts)
    parts[axis] -= parts[axis] > place
    return replace(tie, parts=(parts[0], parts[1]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointPeriodogram:
    """Periodograms of two axes on the same frequencies, and their product."""

    axes: tuple[LoopPeriodogram, LoopPeriodogram]
    crossed: ComplexArray  # (f,): Z1 Z2* at the gains of the axes [nm^2/Hz]

    def merge(self, starts: IntArray) -> JointPeriodogram:
        """Return the means over groups of neighbours that begin at these indices."""
        size = np.diff(np.append(starts, self.crossed.size))
        first, second = (axis.merge(starts) for axis in self.axes)
        return JointPeriodogram(
            axes=(first, second), crossed=np.asarray(np.add.reduceat(self.crossed, starts) / size)
        )

    def powers(self, joint: JointSpectrum) -> tuple[FloatArray, FloatArray]:
        """Return the density of each axis at its gain [nm^2/Hz], (f,) each."""
        each = zip(self.axes, joint.axes, strict=True)
        first, second = (data.power(model.gain) for data, model in each)
        return first, second


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointDensity:
    """The densities of a model, S11, S22 and S12."""

    parts: tuple[FloatArray, FloatArray]  # (1 + parts, f): noise and components of each axis
    shared: tuple[ComplexArray, ...]  # (f,) of each tie: its part of S12
    crossed: ComplexArray  # (f,): S12

    @classmethod
    def of(cls, joint: JointSpectrum, parts: tuple[FloatArray, FloatArray]) -> JointDensity:
        """Return the densities of a model from those of its components on either axis."""
        shared = tuple(
            np.exp(1j * tie.phase) * np.sqrt(parts[0][1 + i] * parts[1][1 + j])
            for tie in joint.ties
            for i, j in [tie.parts]
        )
        nothing = np.zeros(parts[0].shape[1], dtype=np.complex128)
        return cls(parts=parts, shared=shared, crossed=sum(shared, nothing))

    @property
    def diagonal(self) -> tuple[FloatArray, FloatArray]:
        """The density of each axis, (f,)."""
        return self.parts[0].sum(axis=0), self.parts[1].sum(axis=0)


def joint_density(data: JointPeriodogram, joint: JointSpectrum) -> JointDensity:
    """Return the densities of a model."""
    one, other = (densities(d, m)[0] for d, m in zip(data.axes, joint.axes, strict=True))
    return JointDensity.of(joint, (one, other))


def joint_contrast(data: JointPeriodogram, joint: JointSpectrum) -> float:
    """Return L without the priors."""
    density = joint_density(data, joint)
    (first, second), cross = density.diagonal, density.crossed
    determinant = first * second - np.abs(cross) ** 2
    left, right = data.powers(joint)
    trace = second * left + first * right - 2 * (cross.conj() * data.crossed).real
    return float(np.sum(data.axes[0].count * (np.log(determinant) + trace / determinant)))


def joint_derivatives(
    data: JointPeriodogram, joint: JointSpectrum
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its expected information (p, p).

    The parameters are those of the packed vector, as if none were tied.
    """
    bins, end = data.crossed.size, sum(joint.sizes)
    one, other = (densities(d, m) for d, m in zip(data.axes, joint.axes, strict=True))
    density = JointDensity.of(joint, (one[0], other[0]))
    # slopes of S11, S22 and S12 by all parameters
    straight = np.zeros((2, end + len(joint.ties), bins))
    crossed = np.zeros((end + len(joint.ties), bins), dtype=np.complex128)
    straight[0, : joint.sizes[0]] = log_slopes(*one, np.ones(bins))
    straight[1, joint.sizes[0] : end] = log_slopes(*other, np.ones(bins))
    for k, (tie, own) in enumerate(zip(joint.ties, density.shared, strict=True)):
        crossed[end + k] = 1j * own
        for axis, part in enumerate(tie.parts):
            place = joint.place(axis, part)
            slope = straight[axis, place : place + PARAMETERS] / density.parts[axis][1 + part]
            crossed[place : place + PARAMETERS] += 0.5 * own * slope
    count, cross, (first, second) = data.axes[0].count, density.crossed, density.diagonal
    determinant = first * second - np.abs(cross) ** 2

    def whiten(a: FloatArray, b: FloatArray, c: ComplexArray) -> FloatArray:
        """Return ``C^-1 M C^-H`` for S = C C^H, (..., 4 f); products of rows are traces."""
        v = -cross.conj() / np.sqrt(first * determinant)
        w = np.sqrt(first / determinant)
        corner = (a * v.conj() + c * w) * np.sqrt(2 / first)
        last = np.abs(v) ** 2 * a + 2 * w * (v * c).real + w**2 * b
        return np.concatenate([a / first, last, corner.real, corner.imag], axis=-1)

    slopes = whiten(straight[0], straight[1], crossed)
    seen, counts = whiten(*data.powers(joint), data.crossed), np.tile(count, 4)
    rest = np.repeat([1.0, 1.0, 0.0, 0.0], bins) - seen
    value = np.sum(count * (np.log(determinant) + seen[:bins] + seen[bins : 2 * bins]))
    return float(value), slopes @ (counts * rest), (slopes * counts) @ slopes.T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointFit:
    """A minimum of the joint likelihood."""

    joint: JointSpectrum
    data: JointPeriodogram  # as it was fitted
    covariance: FloatArray  # (p, p), of the packed parameters
    by_phase: FloatArray  # (t,): what a free phase of each tie would add to the log-likelihood

    def lost(self, other: JointSpectrum) -> float:
        """Return by how much another model is less likely, without the priors."""
        return joint_contrast(self.data, other) - joint_contrast(self.data, self.joint)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointSearch:
    """The periodograms of two axes, and the models that may be fitted to them."""

    searches: tuple[Search, Search]  # at given gains
    data: JointPeriodogram

    @property
    def price(self) -> float:
        """What a parameter must add to the logarithm of the likelihood."""
        return self.searches[0].price / PARAMETERS

    def merge(self, joint: JointSpectrum) -> JointPeriodogram:
        """Return means over groups of bins within which both spectra are nearly constant."""
        first, second = joint.axes
        return self.data.merge(self.searches[0].groups(first.add(*second.components)))

    def fit(
        self, start: JointSpectrum, *, exact: bool = False, held: frozenset[int] = frozenset()
    ) -> JointFit | None:
        """Fit all parameters but gains and phases; None if no fit settles.

        With ``exact``, errors are those of the second derivatives, not of their expectation. A
        component that would leave the band keeps its frequency, one of those held.
        """
        data, columns = self.merge(start), start.columns()
        first = np.unique(columns, return_index=True)[1]
        distinct, priors = start.pack()[first], self._priors(start, first)
        priors.width[columns[list(held)]] = 0.0
        apart = start.pack() - distinct[columns]  # of tied parameters, which stays
        free, phases = priors.free, columns[columns.size - len(start.ties) :]
        owner = np.zeros((first.size, columns.size))  # adds the slopes of tied parameters
        owner[columns, np.arange(columns.size)] = 1

        def differentiate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            distinct[free] = x
            value, slope, information = joint_derivatives(
                data, start.unpack(distinct[columns] + apart)
            )
            return value, owner @ slope, owner @ information @ owner.T

        def differentiate_free(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            value, slope, information = differentiate(x)
            return value, slope[free], information[np.ix_(free, free)]

        found = scoring_minimum(differentiate_free, distinct[free], priors)
        if found is None:
            return None
        at, information = found
        _, slope, expected = differentiate(at)
        left = self._outside(start.unpack(distinct[columns] + apart)) - held
        if left:
            return self.fit(start, exact=exact, held=held | left)
        moving = np.append(free, phases)
        score = invert_information(expected[np.ix_(moving, moving)])[free.size :, free.size :]
        if exact:
            steps = at + _DIFFERENCE * np.eye(free.size)
            rows = np.array([differentiate_free(step)[1] for step in steps]) - slope[free]
            second = (rows + rows.T) / (2 * _DIFFERENCE) + np.diag(1 / priors.width[free] ** 2)
            if np.min(np.linalg.eigvalsh(second)) > 0:
                information = second
        covariance = np.zeros((first.size, first.size))
        covariance[np.ix_(free, free)] = invert_information(information)
        distinct[free] = at
        return JointFit(
            joint=start.unpack(distinct[columns] + apart),
            data=data,
            covariance=covariance[np.ix_(columns, columns)],
            by_phase=0.5 * slope[phases] ** 2 * np.diag(score),
        )

    def _outside(self, joint: JointSpectrum) -> frozenset[int]:
        """Return where the frequencies of components beyond the band stand in the vector."""
        each = enumerate(zip(self.searches, joint.axes, strict=True))
        return frozenset(
            joint.place(axis, part)
            for axis, (search, model) in each
            for part, component in enumerate(model.components)
            if not search.covers(component)
        )

    def _priors(self, start: JointSpectrum, first: IntArray) -> Priors:
        """Return the priors of the distinct parameters; those of tied ones count once."""
        each = zip(self.searches, start.axes, strict=True)
        both = [search.priors(axis) for search, axis in each]
        fixed = np.zeros(len(start.ties))
        return Priors(
            centre=np.concatenate([*(own.centre for own in both), fixed])[first],
            width=np.concatenate([*(own.width for own in both), fixed])[first],
        )
