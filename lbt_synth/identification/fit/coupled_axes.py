"""Two identified axes with the resonances that they share, each of these with its direction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lbt_synth.identification.fit.close_lines import measure_separations
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedLine
from lbt_synth.identification.fit.joint_whittle import (
    JointFit,
    JointPeriodogram,
    JointSearch,
    joint_derivatives,
)
from lbt_synth.identification.fit.periodogram import cross_periodogram
from lbt_synth.identification.fit.physical_parameters import (
    describe_axis,
    gain_error_covariance,
)
from lbt_synth.identification.fit.shared_lines import find_shared
from lbt_synth.identification.fit.spectrum_model import GAIN, Component
from lbt_synth.identification.fit.whittle import FittedModel, contrast, invert_information
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import FloatArray

_DIFFERENCE = 1e-4  # of a logarithm


def couple_axes(
    record: LoopRecord, axes: Sequence[IdentifiedAxis], stretches: Stretches, lowest_line_hz: float
) -> tuple[list[IdentifiedAxis], tuple[IdentifiedLine, ...], list[str]]:
    """Return two axes with what they share, the shared resonances, and notes.

    Axes that share nothing are returned as they are.
    """
    search_at = partial(_joint_search, record, stretches=stretches, lowest_line_hz=lowest_line_hz)
    search = search_at(axes)
    fit, ellipses = find_shared(search, [axis.fitted_model for axis in axes])
    notes = [
        f"the lines of both axes at {frequency:.4g} Hz move on an ellipse, with a phase between "
        "the axes: they stay two lines"
        for frequency in ellipses
    ]
    fit = None if fit is None else search.fit(fit.joint, exact=True)
    if fit is None:
        return list(axes), (), notes
    fit = _add_gain_errors(fit, axes, search_at)
    coupled = [_describe_axis(search, fit, i, axis) for i, axis in enumerate(axes)]
    parts, shared = [list(axis.parts) for axis in coupled], []
    for k, tie in enumerate(fit.joint.ties):
        lines = [fit.joint.axes[i].components[place] for i, place in enumerate(tie.parts)]
        places = [_find_part(axis, line) for axis, line in zip(coupled, lines, strict=True)]
        shares = [own[place] for own, place in zip(parts, places, strict=True)]
        line = _describe_line(fit, k, shares)
        for own, place, share in zip(parts, places, shares, strict=True):
            own[place] = replace(
                share, direction=line.direction, direction_error_deg=line.direction_error_deg
            )
        shared.append(line)
    shared.sort(key=lambda line: line.frequency_hz)
    each = zip(coupled, parts, strict=True)
    return [replace(axis, parts=tuple(own)) for axis, own in each], tuple(shared), notes


def _joint_search(
    record: LoopRecord, axes: Sequence[IdentifiedAxis], stretches: Stretches, lowest_line_hz: float
) -> JointSearch:
    """Return the periodograms of two identified axes, each at its sensor gain."""
    gains = np.array([axis.sensor_gain for axis in axes])
    first, second = (record.measurements + gains * record.corrections()).T
    crossed = cross_periodogram(
        first, second, frame_rate_hz=record.frame_rate_hz, stretches=sorted(stretches)
    )
    one, other = (
        Search(data=axis.data, gain=axis.sensor_gain, lowest_line_hz=lowest_line_hz)
        for axis in axes
    )
    return JointSearch(
        searches=(one, other),
        data=JointPeriodogram(axes=(axes[0].data, axes[1].data), crossed=crossed),
    )


def _add_gain_errors(
    fit: JointFit,
    axes: Sequence[IdentifiedAxis],
    search_at: Callable[[Sequence[IdentifiedAxis]], JointSearch],
) -> JointFit:
    """Return a fit with what the errors of the gains add to its covariance.

    ``search_at`` returns the periodograms at the gains of the axes.
    """
    starts, covariance = np.array(fit.joint.starts), fit.covariance

    def gradient(step: FloatArray) -> FloatArray:
        """Return the gradient of the contrast at gains that differ by logarithms (2,)."""
        theta = fit.joint.pack()
        theta[starts + GAIN] += step
        joint = fit.joint.unpack(theta)
        each = zip(axes, joint.axes, strict=True)
        search = search_at([replace(axis, sensor_gain=model.gain) for axis, model in each])
        return joint_derivatives(search.merge(joint), joint)[1]

    one_gain = axes[0].sensor_gain == axes[1].sensor_gain
    for members in [[0, 1]] if one_gain else [[0], [1]]:
        step = np.zeros(2)
        step[members] = _DIFFERENCE
        slope = (gradient(step) - gradient(-step)) / (2 * _DIFFERENCE)
        error = (axes[members[0]].sensor_gain_error or 0.0) / axes[members[0]].sensor_gain
        places = (starts[members] + GAIN).tolist()
        covariance = covariance + gain_error_covariance(fit.covariance, slope, places, error)
    return replace(fit, covariance=covariance)


def _describe_axis(
    search: JointSearch, fit: JointFit, i: int, alone: IdentifiedAxis
) -> IdentifiedAxis:
    """Return axis i of a joint fit in the units of the phase."""
    spectrum, start = fit.joint.axes[i], fit.joint.starts[i]
    own = slice(start, start + fit.joint.sizes[i])
    others = range(1, len(spectrum.components))
    evidence = [fit.lost(fit.joint.drop(i, place)) for place in others]
    model = FittedModel(
        spectrum=spectrum,
        contrast=contrast(alone.data, spectrum),
        information=invert_information(fit.covariance[own, own]),  # the other axis left open
        evidence=(float("inf"), *evidence),
    )
    error = alone.sensor_gain_error
    relative = None if error is None else error / alone.sensor_gain
    shared = [tie.parts[i] for tie in fit.joint.ties]
    note = alone.sensor_gain_note
    found = describe_axis(search.searches[i], model, relative, note, shared=shared)
    return measure_separations(found)


def _find_part(axis: IdentifiedAxis, component: Component) -> int:
    """Return which of the parts of an axis a component is."""
    frequency_hz = component.frequency / axis.data.angle_s
    apart = [abs(part.frequency_hz - frequency_hz) for part in axis.parts]
    return int(np.argmin(apart))


def _describe_line(fit: JointFit, k: int, shares: Sequence[IdentifiedLine]) -> IdentifiedLine:
    """Return the resonance of tie k, with its size along its direction, from its shares."""
    tie = fit.joint.ties[k]
    first, second = (share.rms_nm for share in shares)
    rms = float(np.hypot(first, second))
    along = np.array([first, second * np.sign(np.cos(tie.phase))]) / rms
    places = [fit.joint.place(axis, part) + 2 for axis, part in enumerate(tie.parts)]
    slope = np.zeros((2, len(fit.covariance)))  # of the logarithms of both rms
    slope[[0, 1], places], slope[[0, 1], fit.joint.starts] = 0.5, -1.0
    logs = slope @ fit.covariance @ slope.T
    size, turn = along**2, along[0] * along[1] * np.array([-1.0, 1.0])
    error = None if tie.whole else float(np.degrees(np.sqrt(max(turn @ logs @ turn, 0.0))))
    return replace(
        max(shares, key=lambda share: share.prominence),
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(size @ logs @ size)),
        announced=any(share.announced for share in shares),
        direction=(float(along[0]), float(along[1])),
        direction_error_deg=error,
    )
