"""The range of a number, such as a sensor gain, in which a loop that is affine in it is stable.

Where the change of a part has rank one, as the gain of a measurement has, all crossings of the unit
circle are found at once: ``A + d b c'`` has an eigenvalue z where ``d T(z) = 1`` with
``T = c' (z I - A)^-1 b``, and T is real at the angles of the eigenvalues of a symplectic pencil.
Other parts are followed in steps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.optimize.elementwise import find_root

from lbt_synth.linear import StateSpace
from lbt_synth.linear.norms import fold_angles, popov_angles
from lbt_synth.linear.state_space import schur_form, schur_response
from lbt_synth.loop.closed_loop import AffinePart, affine_radii
from lbt_synth.validation import ComplexArray, FloatArray

_STEP = 1.01  # ratio of neighbouring gains in the search for the ends of the interval
_WIDEST = 1e4
_AT_ONCE = 32  # gains, whose loops are in memory together
_RANK = 1e-12  # of a change, a singular value over the largest that counts as zero
_REAL = 1e-9  # of a response, an imaginary part that counts as zero


def stable_range(parts: list[AffinePart], nominal: float) -> tuple[float, float]:
    """Return the interval around a gain in which all parts are stable.

    It is nan where they are not at the nominal gain, 0 and inf beyond a factor of 1e4.
    """
    if not affine_radii(parts, np.array([nominal]))[0] < 1:
        return np.nan, np.nan
    ranges = np.array([_range_of_part(part, nominal) for part in parts])
    low, high = float(ranges[:, 0].max()), float(ranges[:, 1].min())
    return low if low > nominal / _WIDEST else 0.0, high if high < nominal * _WIDEST else np.inf


def _range_of_part(part: AffinePart, nominal: float) -> tuple[float, float]:
    stepped = partial(affine_radii, [part])
    return exact_range(part, nominal) or stable_interval(stepped, nominal)


def exact_range(part: AffinePart, nominal: float) -> tuple[float, float] | None:
    """Return between which numbers a part that is stable at the nominal one stays stable.

    It is None where the matrices repeat with a longer period or change by a higher rank.
    """
    start, slope = part
    if len(start) > 1:
        return None
    U, sizes, V = np.linalg.svd(slope[0])
    if np.any(sizes[1:] > _RANK * sizes[0]):
        return None
    if sizes[0] == 0:
        return -np.inf, np.inf
    b, c = U[:, :1] * sizes[0], V[:1]
    T = StateSpace(A=start[0] + nominal * slope[0], B=b, C=c, D=np.zeros((1, 1))).balanced()
    responses = real_responses(T)
    changes = 1 / responses[responses != 0]
    below, above = changes[changes < 0], changes[changes > 0]
    return nominal + below.max(initial=-np.inf), nominal + above.min(initial=np.inf)


def real_responses(T: StateSpace) -> FloatArray:
    """Return the responses of a system of one input and output that are real, on the unit circle.

    There ``T(z) = T(1/z)``; between the angles of the pencil the imaginary part keeps its sign.
    """
    found = popov_angles(T.A, T.B, np.zeros_like(T.A), T.C, np.zeros_like(T.D), sign=-1.0)
    angles = fold_angles(found, 0.0, np.pi)
    form = schur_form(T)

    def response(at: FloatArray) -> ComplexArray:
        return np.asarray(schur_response(form, np.exp(1j * at))[:, 0, 0])

    def imaginary(at: FloatArray) -> FloatArray:
        return response(at).imag

    middle = (angles[1:] + angles[:-1]) / 2
    signs = np.sign(imaginary(middle))
    known = response(angles)
    real = np.abs(known.imag) <= _REAL * np.abs(known)
    (turns,) = np.nonzero((signs[1:] * signs[:-1] < 0) & ~real[1:-1])  # of an inaccurate angle
    crossed = np.zeros(0)
    if turns.size:
        ends = middle[turns], middle[turns + 1]
        crossed = find_root(imaginary, ends, tolerances={"xatol": 1e-15, "xrtol": 0.0}).x
    return np.concatenate([known[real].real, response(crossed).real])


def stable_interval(
    radii: Callable[[FloatArray], FloatArray], nominal: float = 1.0
) -> tuple[float, float]:
    """Return the interval around a gain in which radii (g,) of gains (g,) are below 1.

    It is sought as :func:`stable_sensor_gains` says.
    """

    def is_stable(gain: float) -> bool:
        return float(radii(np.array([gain]))[0]) < 1

    if not is_stable(nominal):
        return float("nan"), float("nan")
    ends = []
    for ratio, open_end in ((1 / _STEP, 0.0), (_STEP, np.inf)):
        count = int(np.ceil(np.log(_WIDEST) / np.log(_STEP)))
        gains = np.asarray(nominal * ratio ** np.arange(count + 1), dtype=np.float64)
        parts = (range(i, min(i + _AT_ONCE, count + 1)) for i in range(0, count + 1, _AT_ONCE))
        outside = (part[i] for part in parts for i in np.flatnonzero(radii(gains[part]) >= 1))
        first = next(outside, None)
        if first is None:
            ends.append(open_end)
            continue
        inner, outer = gains[first - 1], gains[first]
        for _ in range(40):
            middle = (inner + outer) / 2
            inner, outer = (middle, outer) if is_stable(middle) else (inner, middle)
        ends.append(float(inner))
    return ends[0], ends[1]
