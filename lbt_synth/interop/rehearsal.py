"""A controller in the arithmetic of a target, in the loop, beside itself in double precision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Check, Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.interop.pipeline import export, target_named
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.loop import close_loop
from lbt_synth.loop.simulation.run import Simulation, record_run, settling_frames, step_loop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, float_array, number

_MOST_SETTLING = 0.25  # part of the frames that the loops may settle in


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rehearsal:
    """A target and the design itself on the same series, after both loops have settled.

    Attributes
    ----------
    target, design : Simulation
        In the arithmetic of the target, and in double precision; of one case each. The residual is
        less noise that was given apart, and commands are those that the mirror got.
    settle_frames : int
        Frames at the beginning that are left out.
    stroke : float
        Largest modulus of a command; infinite without a limit.
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
    total_nm: ArrayLike,
    *,
    hardware: LoopHardware | None = None,
    noise: ArrayLike | None = None,
    sensor_gain: float = 1.0,
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
    total_nm : (frames, n) array_like
        Phase of each frame; or the pseudo-open-loop series of a record, whose noise is then part
        of the residual [nm].
    hardware : LoopHardware, optional
        The loop; by default that of the design.
    noise : (frames, q) array_like, optional
        Noise of the measurements; none by default.
    sensor_gain : float, optional
        Real sensor gain relative to the sensor matrix.
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
    >>> phase = 100 * np.sin(np.arange(2000.0)[:, None] / 50)
    >>> run = lbt.interop.rehearse(slow, "dao", phase)
    >>> bool(0 < np.max(np.abs(run.differences)) < 1e-3)
    True
    """
    controller = as_controller(design)
    path = require_hardware(design, "a rehearsal") if hardware is None else hardware
    total = float_array(total_nm, "total_nm")
    seen = (
        np.zeros((len(total), path.n_measurements))
        if noise is None
        else float_array(noise, "noise")
    )
    if total.ndim != 2 or total.shape[1] != path.modes or len(seen) != len(total):
        raise DimensionError(
            f"total_nm must be (frames, {path.modes}), with as many frames of noise; got "
            f"{total.shape} and {seen.shape}."
        )
    gain = number(sensor_gain, "sensor_gain", above=0)
    limit = np.inf if stroke is None else number(stroke, "stroke", above=0, at_most=1e30)
    loop = close_loop(path, controller, sensor_gain=gain)
    loop.require_stable()
    settle = min(settling_frames(loop.spectral_radius), int(_MOST_SETTLING * len(total)))
    with TemporaryDirectory() as folder:
        exported = export(target_named(target).path_in(Path(folder)), design, target)
    runs = []
    for running in (exported.start(limit), controller.start()):
        try:
            with np.errstate(all="ignore"):  # what overflows is found to be infinite
                out = step_loop(running, gain, path, total[None], seen[None], stroke=limit)
        except ProblemError as error:
            raise NumericalError(
                f"in the arithmetic of {target} the loop grows beyond all numbers: {error}",
                status="arithmetic",
            ) from error
        runs.append(record_run(total[None], out, path, settle=settle, seed=0))
    return Rehearsal(
        target=runs[0],
        design=runs[1],
        settle_frames=settle,
        stroke=limit,
        checks=exported.checks,
    )
