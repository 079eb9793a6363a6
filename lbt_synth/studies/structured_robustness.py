"""How much sensor gain, delay and mirror may be off at the same time: the structured bound.

Around a loop with the sensitivity S at its measurements, the chain behind the controller becomes
``(1 + gain dg) (1 + delay V dd) (1 + mirror dm)`` times itself, with a real dg for each measurement
(or one for all) and complex dd and dm of modulus at most one, the same for all measurements. The
weight V covers the delay: ``|exp(-i theta tau) - 1| <= tau theta <= tau |V|`` for all angles theta
up to pi, with equality at pi.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Block, StateSpace, mu_bound
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import FloatArray, number, require_instance

_POLE = (2 - np.pi) / (2 + np.pi)
_SLOPE = 2 * np.pi / (2 + np.pi)  # V = slope (z - 1) / (z - pole)
_LARGEST = 1000.0  # size of an error; no loop is near it
_TOLERANCE = 2e-3


@table_row
class StructuredRobustness:
    """What a loop survives of uncertainties that occur at the same time."""

    design: str = column("design", default="", help="Name of the design; empty for a loop")
    proved: float = column(
        "stable up to",
        format=".3f",
        help="Part of the given sizes, all at once, proved to be stable",
    )
    unstable: float = column(
        "unstable at",
        format=".3f",
        help="Part at which a combination was found that is not; inf without one",
    )
    frequency_hz: float = column(
        "at", unit="Hz", format=".4g", help="Frequency at which that combination oscillates"
    )
    sensor_gains: str = column(
        "sensor gains", help="Its factors on the sensor gains, one per measurement"
    )
    delay_gain: float = column("delay: gain", format=".3f", help="Its gain error of the delay")
    delay_phase_deg: float = column(
        "phase", unit="deg", format="+.1f", help="Its phase error of the delay"
    )
    mirror_gain: float = column("mirror: gain", format=".3f", help="Its gain error of the mirror")
    mirror_phase_deg: float = column(
        "phase", unit="deg", format="+.1f", help="Its phase error of the mirror"
    )


def structured_robustness(
    design: Design | ClosedLoop,
    *,
    gain: float = 0.3,
    delay_frames: float = 0.2,
    mirror: float = 0.1,
    common_gain: bool = False,
) -> StructuredRobustness:
    """Bound how much sensor gain, delay and mirror may be off at the same time.

    Parameters
    ----------
    design : Design or ClosedLoop
        A design, closed around its own hardware, or a loop.
    gain : float, optional
        Relative error of the sensor gain of each measurement, either way.
    delay_frames : float, optional
        Error of the delay, either way [frames].
    mirror : float, optional
        Relative error of the mirror's response at any frequency, with any phase.
    common_gain : bool, optional
        Whether all measurements have one sensor gain.

    Returns
    -------
    StructuredRobustness
        All errors up to ``proved`` times these sizes at once leave the loop stable; at
        ``unstable`` times these sizes a combination does not.

    Raises
    ------
    ProblemError
        If all sizes are zero, one is negative or above 1000, or the design knows no hardware.
    UnstableLoopError
        If the loop is not stable without errors.

    Examples
    --------
    An integrator of gain 0.5 in a two-frame loop is stable up to twice its gain:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    >>> found = lbt.studies.structured_robustness(loop, gain=0.5, delay_frames=0.2, mirror=0.1)
    >>> bool(0.8 < found.proved <= found.unstable < 1.0)
    True
    """
    loop = _closed(design)
    loop.require_stable()
    sizes = {"mirror": mirror, "delay_frames": delay_frames, "gain": gain}
    for name, size in sizes.items():
        number(size, name, at_least=0, at_most=_LARGEST, hint="1 is an error of 100 %, or a frame.")
    if not any(sizes.values()):
        raise ProblemError("at least one of gain, delay_frames and mirror must be above 0.")
    q = loop.hardware.n_measurements
    gains = (Block(size=q, kind="real"),) if common_gain else (Block(kind="real"),) * q
    whole = Block(size=q, kind="complex")
    blocks = [
        block
        for size, own in ((mirror, (whole,)), (delay_frames, (whole,)), (gain, gains))
        for block in own
        if size > 0
    ]
    kept = np.repeat([mirror > 0, delay_frames > 0, gain > 0], q)
    system = uncertain_loop(loop.output_sensitivity(), gain, delay_frames, mirror)
    system = replace(system, B=system.B[:, kept], C=system.C[kept], D=system.D[np.ix_(kept, kept)])
    bound = mu_bound(system, blocks, tolerance=_TOLERANCE)
    z = np.exp(2j * np.pi * bound.delta_frequency_hz * loop.hardware.dt_s)
    values = np.zeros(3 * q, dtype=complex)
    if bound.delta is not None:
        values[kept] = np.diag(bound.delta)
    moved = 1 + mirror * values[0]
    late = 1 + delay_frames * _SLOPE * (z - 1) / (z - _POLE) * values[q]
    factors = 1 + gain * values[2 * q :].real
    return StructuredRobustness(
        proved=1 / bound.upper if bound.upper else np.inf,
        unstable=1 / bound.lower if bound.lower else np.inf,
        frequency_hz=bound.delta_frequency_hz,
        sensor_gains=", ".join(f"{each:.3f}" for each in factors),
        delay_gain=float(abs(late)),
        delay_phase_deg=float(np.degrees(np.angle(late))),
        mirror_gain=float(abs(moved)),
        mirror_phase_deg=float(np.degrees(np.angle(moved))),
    )


def _closed(design: Design | ClosedLoop) -> ClosedLoop:
    if isinstance(design, ClosedLoop):
        return design
    require_instance(design, Design, "design")
    return close_loop(require_hardware(design, "structured robustness"), design)


def uncertain_loop(
    sensitivity: StateSpace, gain: float, delay_frames: float, mirror: float
) -> StateSpace:
    """Return the system around which the errors of mirror, delay and gains close, in this order.

    With ``T = I - S`` and w their outputs, the chain gives ``-T (w1 + w2 + w3)`` before the first
    error, and the outputs of those before it more at each of the others.
    """
    S, q = sensitivity, len(sensitivity.D)
    one = np.eye(q)
    B, C = np.tile(S.B, (1, 3)), np.tile(S.C, (3, 1))
    D = np.tile(S.D - one, (3, 3)) + np.kron(np.tri(3, k=-1), one)
    late = slice(q, 2 * q)
    A = np.block([[S.A, np.zeros((len(S.A), q))], [S.C, _POLE * one]])
    size = np.repeat([mirror, delay_frames * _SLOPE, gain], q)[:, None]
    memory: FloatArray = np.zeros((3 * q, q))
    memory[late] = (_POLE - 1) * one
    return StateSpace(
        A=A,
        B=np.vstack([B, D[late]]),
        C=size * np.hstack([C, memory]),
        D=size * D,
        dt_s=S.dt_s,
    )
