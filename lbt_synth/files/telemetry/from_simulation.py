"""Makes telemetry of one case of a simulation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files.telemetry.telemetry import Scalar, Telemetry
from lbt_synth.loop import Imaging, Simulation
from lbt_synth.models import LoopHardware
from lbt_synth.validation import integer, require_instance


def telemetry_from_simulation(
    simulation: Simulation,
    hardware: LoopHardware,
    *,
    case: int = 0,
    sensor_gain: float | None = None,
    design: Design | None = None,
    controller_digest: str | None = None,
    imaging: Imaging | None = None,
    name: str = "",
    metadata: Mapping[str, Scalar] | None = None,
) -> Telemetry:
    """Telemetry of one case of a simulation.

    Parameters
    ----------
    simulation : Simulation
        The simulation.
    hardware : LoopHardware
        The loop that was simulated.
    case : int, optional
        Which case, from 0.
    sensor_gain : float, optional
        Sensor gain of the truth, relative to the sensor matrix of the loop.
    design : Design, optional
        The design that ran.
    controller_digest : str, optional
        SHA-256 of its gain file.
    imaging : Imaging, optional
        The camera: gives the telescope, the wavelength and, of one or two modes, the Strehl
        ratio of the case.
    name : str, optional
        Name of the system.
    metadata : mapping, optional
        Anything else; see :class:`Telemetry`.

    Returns
    -------
    Telemetry
        Series in nm, with the true phase before and after the correction.

    Raises
    ------
    ProblemError
        If there is no such case, or the loop is not that of the simulation.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100),),
    ... )
    >>> run = lbt.simulate(lazy.controller, shake, hardware=path, frames=100)
    >>> seen = lbt.files.telemetry_from_simulation(run, path, design=lazy)
    >>> bool(abs(seen.measurements[1:] - seen.residual_nm[:-1]).max() < 1e-9)  # no noise
    True
    """
    require_instance(simulation, Simulation)
    require_instance(hardware, LoopHardware)
    case = integer(case, "case", at_least=0)
    cases = len(simulation.commands)
    if case >= cases:
        raise ProblemError(f"case must be below the number of cases, {cases}; got {case}.")
    if simulation.frame_rate_hz != hardware.frame_rate_hz:
        raise ProblemError(
            f"hardware must be that of the simulation, at {simulation.frame_rate_hz:g} Hz; got "
            f"one at {hardware.frame_rate_hz:g} Hz."
        )
    gains = None
    if design is not None:
        require_instance(design, Design)
        if (gain := design.integrator_gain) is not None:
            gains = np.full(hardware.n_commands, gain)
    residual, strehl = simulation.residual_nm[case], None
    if imaging is not None and residual.shape[1] <= 2:  # the jitter of an image has two axes
        strehl = float(np.clip(simulation.strehl(imaging)[case], 0, 1))  # a mean of cosines
    return Telemetry(
        frame_rate_hz=simulation.frame_rate_hz,
        delay_frames=hardware.delay_frames,
        mirror=hardware.mirror,
        commands=simulation.commands[case],
        measurements=simulation.measurements[case],
        residual_nm=residual,
        total_nm=simulation.total_nm[case],
        interaction_matrix=hardware.sensor,
        influence_matrix=hardware.influence,
        sensor_gain=sensor_gain,
        controller=None if design is None else design.controller,
        controller_name=None if design is None else design.method,
        controller_digest=controller_digest,
        integrator_gains=gains,
        diameter_m=None if imaging is None else imaging.diameter_m,
        obstruction=None if imaging is None else imaging.obstruction,
        imaging_wavelength_um=None if imaging is None else imaging.wavelength_um,
        strehl=strehl,
        seed=simulation.seed,
        name=name,
        metadata=metadata or {},
    )
