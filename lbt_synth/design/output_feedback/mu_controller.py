"""Robust performance: D-K iteration for a small structured singular value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from lbt_synth.design.output_feedback.hinf_controller import hinf_controller
from lbt_synth.design.output_feedback.result import (
    ControllerDesign,
    System,
    certified_controller,
    checked_loop,
)
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.linear import Block, GeneralizedPlant, StateSpace, mu_bound
from lbt_synth.linear.output_feedback.discrete_form import DiscreteForm, discrete_form
from lbt_synth.linear.structured_singular_value.blocks import checked_blocks, places
from lbt_synth.linear.structured_singular_value.scales import best_scales
from lbt_synth.linear.weights import Weight, constant_weight, stack_weights, weigh_plant
from lbt_synth.validation import FloatArray, integer, require_instance

_POINTS = 65  # frequencies at which scales are fitted
_RATIO = 1.02  # of the least gamma, so that controllers stay ordinary
_ENOUGH = 1e-3  # relative improvement below which the iteration ends
_FARTHEST = 0.999  # modulus of a pole or zero of a scale


def mu_controller(
    plant: GeneralizedPlant,
    blocks: Sequence[Block],
    *,
    order: int = 1,
    iterations: int = 8,
) -> ControllerDesign:
    """Design a controller for robust performance by D-K iteration.

    The uncertainty closes w and z in its blocks; for robust performance the last block is that
    of performance, from the disturbances to the errors proper. H-infinity synthesis for fixed
    scales D and the best scales for a fixed controller take turns. The problem is not convex, and
    the iteration finds a local optimum; but each step is certified by a bound of the structured
    singular value that holds at all frequencies, and the best is returned.

    Parameters
    ----------
    plant : GeneralizedPlant
        In discrete time.
    blocks : sequence of Block
        The uncertainty from z to w, in their order. For the design a real block counts as a
        complex one, and a repeated one gets the same scale on each channel.
    order : int
        Order of each scale, 0 to 3; each adds its order to the controller, twice a channel.
    iterations : int
        Most turns.

    Returns
    -------
    ControllerDesign
        Certified; ``mu`` bounds the structured singular value of the closed loop at all
        frequencies: no uncertainty of these blocks below ``1 / mu`` destabilises. ``gamma`` is the
        norm without scales.

    Raises
    ------
    ProblemError
        If the plant is in continuous time, or the blocks do not fit it.
    DetectabilityError, NumericalError, CertificateError
        As :func:`hinf_controller`.

    References
    ----------
    A. Packard, J. Doyle, Automatica 29, 71 (1993), doi:10.1016/0005-1098(93)90175-S.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> P = lbt.linear.GeneralizedPlant(
    ...     A=0.9,
    ...     B1=[[0.0, 1.0]],
    ...     B2=1.0,
    ...     C1=[[0.0], [1.0]],
    ...     C2=1.0,
    ...     D12=[[0.5], [0.0]],
    ...     D21=[[0.3, 0.0]],
    ... )
    >>> two = (lbt.linear.Block(), lbt.linear.Block())
    >>> K = lbt.mu_controller(P, two)
    >>> bool(lbt.linear.mu_bound(K.closed_loop, two).upper == K.mu < lbt.hinf_controller(P).gamma)
    True
    """
    require_instance(plant, GeneralizedPlant, "plant")
    if plant.dt_s is None:
        raise ProblemError(
            "mu_controller needs a plant in discrete time; got dt_s=None. Try "
            "control.sample_system."
        )
    m1, _, p1, _ = plant.sizes
    given = checked_blocks(blocks, (p1, m1))
    order = integer(order, "order", at_least=0, at_most=3)
    form = discrete_form(plant)
    best = _bounded(hinf_controller(plant, gamma_ratio=_RATIO).controller, form, given)
    design = best
    for _ in range(integer(iterations, "iterations", at_least=1, at_most=50)):
        try:
            scaled = _scaled_plant(plant, design.closed_loop, given, order)
            found = hinf_controller(scaled, gamma_ratio=_RATIO)
            design = _bounded(found.controller, form, given)
        except (NumericalError, CertificateError):  # scales that the equations do not bear
            break
        improved = design.mu < best.mu * (1 - _ENOUGH)
        best = design if design.mu < best.mu else best
        if not improved:
            break
    return best


def _bounded(controller: System, form: DiscreteForm, blocks: Sequence[Block]) -> ControllerDesign:
    """Return a controller as a certified design of the plant, with its bound of mu."""
    assert isinstance(controller, StateSpace)  # the plant is in discrete time
    checked = checked_loop(form, form.scaled(controller))
    design = certified_controller(form, checked, method="mu", route="D-K iteration")
    return replace(design, mu=mu_bound(design.closed_loop, blocks).upper)


def _scaled_plant(
    plant: GeneralizedPlant, loop: System, blocks: Sequence[Block], order: int
) -> GeneralizedPlant:
    """Return the plant with the best scales of a loop, fitted, on its errors and disturbances."""
    assert isinstance(loop, StateSpace)  # the plant is in discrete time
    frequency_hz = np.linspace(0, 0.5 / loop.dt_s, _POINTS)
    sizes = np.empty((len(blocks), _POINTS))
    own = places(blocks)
    for i, response in enumerate(loop.frequency_response(frequency_hz)):
        D = np.real(np.diag(best_scales(response, blocks).outputs))
        sizes[:, i] = [np.sqrt(np.mean(D[columns])) for _, columns in own]
    sizes /= sizes[-1]  # the last block keeps its size
    angles = 2 * np.pi * frequency_hz * loop.dt_s
    orders = [order] * (len(blocks) - 1) + [0]
    scales = [_fitted_scale(angles, *each) for each in zip(sizes, orders, strict=True)]
    left = _repeated(scales, [columns for _, columns in own])
    right = _repeated([_inverse(scale) for scale in scales], [rows for rows, _ in own])
    return weigh_plant(plant, left, right)


def _fitted_scale(angles: FloatArray, size: FloatArray, order: int) -> Weight:
    """Fit ``k prod (z - a) / (z - b)``, all a and b real and inside the circle, to a modulus."""
    z = np.exp(1j * angles)
    target = np.log(size)

    def parts(values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        turned = _FARTHEST * np.tanh(values[1:])
        return float(values[0]), turned[:order], turned[order:]

    def apart(values: FloatArray) -> FloatArray:
        gain, zeros, poles = parts(values)
        modulus = np.full(len(z), gain)
        for zero, pole in zip(zeros, poles, strict=True):
            modulus += np.log(np.abs(z - zero)) - np.log(np.abs(z - pole))
        return modulus - target

    spread = np.linspace(0.3, 1.5, max(order, 1))[:order]
    start = np.concatenate([[np.mean(target)], spread, spread])
    gain, zeros, poles = parts(least_squares(apart, start).x)
    A, B, C, D = constant_weight(np.array([[np.exp(gain)]]))
    for zero, pole in zip(zeros, poles, strict=True):  # (z - a)/(z - b) = 1 + (b - a)/(z - b)
        A = np.block([[A, np.zeros((len(A), 1))], [C, np.array([[pole]])]])
        B, C = np.vstack([B, D]), np.hstack([C, np.array([[pole - zero]])])
    return Weight(A, B, C, D)


def _inverse(scale: Weight) -> Weight:
    back = 1 / scale.D
    A = scale.A - scale.B @ back @ scale.C
    return Weight(A, scale.B @ back, -back @ scale.C, back)


def _repeated(scales: Sequence[Weight], channels: Sequence[slice]) -> Weight:
    """Return the scales on their channels, as one weight."""
    return stack_weights(
        scale
        for scale, own in zip(scales, channels, strict=True)
        for _ in range(own.stop - own.start)
    )
