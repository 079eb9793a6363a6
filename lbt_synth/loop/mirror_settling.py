"""The error of assuming that the mirror settles at once: phi_cor(k-1) = N u(k-2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.linear import StateSpace
from lbt_synth.loop.budget import ResidualBudget, residual_budget
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.models import Truth


def settling_error(loop: ClosedLoop, truth: Truth) -> ResidualBudget:
    """Position of a settled mirror less the real one, for the commands that a loop gives.

    The paper's equation 1, ``phi_cor(k-1) = N u(k-2)`` (at its delay of two frames), is exact
    for a mirror that settles at once; this is by how much it misses the position averaged
    over the exposure. It is no residual: the loop corrects for part of it.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, with the real mirror in its hardware.
    truth : Truth
        Disturbances; its sensor gain must be the loop's.

    Returns
    -------
    ResidualBudget
        Covariances of the difference, by origin; ``rms_nm`` is its size.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If a vibration does not fit the loop, or the sensor gains differ.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
    ... )
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     noise_nm=1.0,
    ...     vibrations=(
    ...         lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100, direction=(1,)),
    ...     ),
    ... )
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    >>> missed = lbt.loop.settling_error(loop, shake)
    >>> 0 < missed.rms_nm < lbt.residual_budget(loop, shake).rms_nm
    True
    """
    return residual_budget(replace(loop, system=_difference_loop(loop)), truth)


def _difference_loop(loop: ClosedLoop) -> StateSpace:
    """Loop whose first outputs are the settled mirror's position less the real one."""
    s, n, m = loop.system, loop.hardware.modes, loop.hardware.n_commands
    if loop.hardware.mirror is None:  # it leaves nothing, not even rounding
        C, D = np.vstack([0 * s.C[:n], s.C[n:]]), np.vstack([0 * s.D[:n], s.D[n:]])
        return replace(s, C=C, D=D)
    ideal = replace(loop.hardware, mirror=None).mirror_system.whole
    real = loop.hardware.mirror_system.whole
    each, influence = np.eye(m), loop.hardware.influence
    command, through = s.C[n : n + m], s.D[n : n + m]
    entry = np.kron(np.concatenate([ideal.B, real.B])[:, None], each)
    position = influence @ np.kron(np.concatenate([ideal.C, -real.C]), each)
    direct = (ideal.D - real.D) * influence
    past = np.kron(block_diag(ideal.A, real.A), each)
    return StateSpace(
        A=np.block([[s.A, np.zeros((s.n_states, len(past)))], [entry @ command, past]]),
        B=np.vstack([s.B, entry @ through]),
        C=np.block([[direct @ command, position], [s.C[n:], np.zeros((len(s.C) - n, len(past)))]]),
        D=np.vstack([direct @ through, s.D[n:]]),
        dt_s=s.dt_s,
    )
