"""A controller in the arithmetic of a target, in the loop, beside itself in double precision."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lbt_synth.design import Check, Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.interop.pipeline import export, target_named
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import close_loop
from lbt_synth.loop.simulation.disturbances import Disturbance
from lbt_synth.loop.simulation.run import Simulation, settling_frames, simulate
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, number, require_instance

_MOST_SETTLING = 0.25  # part of the frames that the loops may settle in


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rehearsal:
    """A target and the design itself on the same series, after both loops have settled.

    Attributes
    ----------
    target, design : Simulation
        In the arithmetic of the target, and in double precision; commands are as they were applied.
    settle_frames, stroke : int, float
        Frames at the beginning that are left out; largest modulus of a command, or infinity.
    checks : tuple of Check
        The proof of what the target runs, as in its certificate.
    """

    target: Simulation
    design: Simulation
    settle_frames: int
    stroke: float
    checks: tuple[Check, ...]

    @property
    def differences(self) -> FloatArray:
        """Commands of the target less those of the design, (frames, m)."""
        return np.asarray(self.target.commands[0] - self.design.commands[0])

    def clipped_frames(self, run: Simulation) -> int:
        """Return the frames of a run in which a command reached the stroke."""
        return int(np.sum(np.any(np.abs(run.commands[0]) >= self.stroke, axis=1)))


def rehearse(
    design: Design,
    target: str,
    disturbance: Disturbance,
    *,
    hardware: LoopHardware | None = None,
    stroke: float | None = None,
) -> Rehearsal:
    """Run what is exported to a target in its arithmetic, and the design in double precision.

    Both loops run frame by frame, on the same series.

    Parameters
    ----------
    design : Design
        The design.
    target : str
        Name of a target, whose export has its usual options.
    disturbance : Disturbance
        Phase and noise of one case. The pseudo-open-loop series of a record may stand for the
        phase; its noise is then part of the residual, and ``frame_means`` keeps it out of what
        moves within frames.
    hardware : LoopHardware, optional
        The loop; by default that of the design.
    stroke : float, optional
        Largest modulus of a command that the mirror applies; without a limit by default.

    Returns
    -------
    Rehearsal
        Both loops, on the frames after they have settled.

    Raises
    ------
    ProblemError
        If the target cannot hold the design, it reads several sensors, or sizes clash.
    CertificateError
        If the certificate that the design carries has a failed check.
    UnstableLoopError
        If the loop of the design is unstable.
    NumericalError
        If the export is refused, or the loop grows beyond all numbers in its arithmetic.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.5)
    >>> wave = lbt.loop.Disturbance(phase_nm=100 * np.sin(np.arange(2000.0)[:, None] / 50))
    >>> run = lbt.interop.rehearse(slow, "dao", wave)
    >>> bool(0 < np.max(np.abs(run.differences)) < 1e-3)
    True
    """
    controller = as_controller(design)
    path = require_hardware(design, "a rehearsal") if hardware is None else hardware
    require_instance(disturbance, Disturbance, "disturbance")
    cases, frames, n = disturbance.phase_nm.shape
    if (cases, n) != (1, path.modes):
        raise DimensionError(
            f"phase_nm must be (frames, {path.modes}), of one case; got "
            f"{disturbance.phase_nm.shape}."
        )
    limit = np.inf if stroke is None else number(stroke, "stroke", above=0, at_most=1e30)
    loop = close_loop(path, controller, sensor_gain=disturbance.sensor_gain)
    loop.require_stable()
    settle = min(settling_frames(loop.spectral_radius), int(_MOST_SETTLING * frames))
    with TemporaryDirectory() as folder:
        exported = export(target_named(target).path_in(Path(folder)), design, target)
    run = partial(simulate, hardware=path, settle_frames=settle, stroke=stroke)
    try:
        with np.errstate(all="ignore"):  # what overflows is found to be infinite
            runs = [run(c, disturbance) for c in (exported.start(limit), controller.start())]
    except ProblemError as error:
        raise NumericalError(
            f"in the arithmetic of {target} the loop grows beyond all numbers: {error}",
            status="arithmetic",
        ) from error
    return Rehearsal(
        target=runs[0], design=runs[1], settle_frames=settle, stroke=limit, checks=exported.checks
    )
