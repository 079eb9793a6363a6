"""Demands of a shaped design that another controller of its loop violates."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from lbt_synth.design.loop_shaping import ShapedDesign
from lbt_synth.design.shaping.channel import SingleModeLoop
from lbt_synth.errors import UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray

_ZERO = 1e-12  # of an entry, over the largest of its matrix


def violated_demands(design: ShapedDesign, controller: Controller) -> tuple[str, ...] | None:
    """Return the demands of a design that a controller violates; None if it couples the modes."""
    found: dict[str, None] = {}
    for mode, specification in enumerate(design.specifications):
        alone = _controller_of_mode(controller, design.loop_hardware, mode)
        if alone is None:
            return None
        loop = SingleModeLoop(hardware=design.loop_hardware.single_mode(), controller=alone)
        for demand in specification.demands:
            try:
                met = all(check.passed for check in demand.checks(loop))
            except UnstableLoopError:
                met = False
            if not met:
                found[demand.label] = None
    return tuple(found)


def _controller_of_mode(
    controller: Controller, hardware: LoopHardware, mode: int
) -> Controller | None:
    """Return the part of a controller that acts on a mode, None if it mixes modes."""
    A, B = controller.A, controller.B @ hardware.sensor
    C = hardware.influence @ controller.C
    D = hardware.influence @ controller.D @ hardware.sensor
    n, modes = len(A), len(D)
    whole = np.zeros((n + modes, n + modes))  # which state or mode acts on which
    whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:] = map(_entries, (A, B, C, D))
    _, label = connected_components(whole)
    if np.count_nonzero(label[n:] == label[n + mode]) > 1:
        return None
    own = label[:n] == label[n + mode]
    return Controller(
        A=A[np.ix_(own, own)],
        B=B[own, mode : mode + 1],
        C=C[mode : mode + 1, own],
        D=D[mode : mode + 1, mode : mode + 1],
        dt_s=controller.dt_s,
    )


def _entries(matrix: FloatArray) -> FloatArray:
    """Return 1 where a matrix has an entry, and 0 where it has rounding."""
    size = np.abs(matrix)
    return np.asarray(size > _ZERO * np.max(size, initial=0.0), dtype=np.float64)
