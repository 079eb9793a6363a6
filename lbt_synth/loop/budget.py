"""The exact residual of one closed loop, by origin: turbulence, vibrations, noise.

White noise and auto-regressive disturbances are solved by a Lyapunov equation, spectra by
adaptive quadrature on panels that crowd at the loop's resonances, sinusoids by the frequency
response. The same budget serves the error of assuming that the mirror settles at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.lyapunov import stationary_root
from lbt_synth.linear.quadrature import adaptive_integral, panel_edges
from lbt_synth.loop.closed_loop import ClosedLoop, require_loop_rate
from lbt_synth.loop.residual import ResidualBudget, require_true_gain
from lbt_synth.loop.sensor_budget import budget_of_sensors
from lbt_synth.models import ARModel, Spectrum, TipTiltPlant, Truth, Vibration
from lbt_synth.models.spectra import breakpoints_below, spectrum_density
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, require_instance


def residual_budget(loop: ClosedLoop, truth: Truth) -> ResidualBudget:
    """Exact stationary residual of a loop under a truth.

    Parameters
    ----------
    loop : ClosedLoop
        The loop; its sensor gain must be the truth's.
    truth : Truth
        Disturbances.

    Returns
    -------
    ResidualBudget
        Covariances by origin.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If a vibration, the turbulence or the noise does not fit the loop, or the sensor gains
        differ.

    Examples
    --------
    Noise through an integrator of gain g and delay 1 has the variance g / (2 - g):

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> budget = lbt.residual_budget(
    ...     lbt.close_loop(path, lazy), lbt.Truth(turbulence=None, noise_nm=3.0)
    ... )
    >>> round(budget.noise_nm**2, 9)
    3.0
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    require_true_gain(loop.sensor_gain, truth)
    n, noise_nm = loop.hardware.modes, truth.noise_per_measurement(loop.hardware.n_measurements)
    if loop.reads_others:
        return budget_of_sensors(loop, truth, np.diag(noise_nm))
    turbulence = np.zeros((n, n))
    for spectrum, modes in truth.turbulence_groups(n):
        if isinstance(spectrum, ARModel):
            turbulence += ar_covariance(loop, spectrum, np.eye(n)[list(modes)])
        else:
            turbulence += _spectrum_covariance(loop, spectrum, modes)

    random_vibration = np.zeros((n, n))
    lines = []
    for vibration in stationary_vibrations(truth.vibrations):
        direction = checked_direction(vibration, loop.hardware)
        if isinstance(vibration, Vibration):
            model = vibration.ar_model(loop.hardware.frame_rate_hz)
            random_vibration += ar_covariance(loop, model, direction[None])
        else:
            response = loop.sensitivity([vibration.frequency_hz])[0]
            lines.append(vibration.amplitude_nm * response @ direction)
    return _make_budget(loop, turbulence, np.diag(noise_nm), random_vibration, lines)


def model_budget(loop: ClosedLoop, plant: TipTiltPlant) -> ResidualBudget:
    """Exact stationary residual of a loop where a plant's model is the truth.

    Each mode has its own turbulence and each measurement its own noise, as in the plant.

    Parameters
    ----------
    loop : ClosedLoop
        A loop of the plant's hardware, around any controller.
    plant : TipTiltPlant
        Turbulence, vibrations and noise.

    Returns
    -------
    ResidualBudget
        Covariances by origin.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If the loop has another sensor, mirror or delay than the plant.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
    >>> design = lbt.kalman(plant)
    >>> loop = lbt.close_loop(plant.hardware, design.controller)
    >>> bool(abs(lbt.loop.model_budget(loop, plant).rms_nm / design.rms - 1) < 1e-9)
    True
    """
    require_instance(plant, TipTiltPlant)
    require_instance(loop, ClosedLoop)
    one, other = loop.hardware, plant.hardware
    pairs = [(loop.sensor_gain * one.sensor, other.sensor), (one.influence, other.influence)]
    alike = (
        all(a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=0) for a, b in pairs)
        and one.delay_frames == other.delay_frames
        and one.mirror == other.mirror
    )
    if not alike:
        raise ProblemError(
            "the loop must have the plant's sensor, mirror and delay; got another. Close it with "
            "close_loop(plant.hardware, controller)."
        )
    return plant_budget(loop, plant)


def plant_budget(loop: ClosedLoop, plant: TipTiltPlant) -> ResidualBudget:
    """Return what a plant's disturbances and noise leave in any loop, at its own sensor gain."""
    loop.require_stable()
    one, n, noise_factor = loop.hardware, loop.hardware.modes, plant.own_noise_factor
    if loop.reads_others:
        model = Truth(
            turbulence=plant.turbulence, vibrations=plant.vibrations, motions=plant.motions
        )
        return budget_of_sensors(loop, model, noise_factor)
    turbulence, vibration = np.zeros((2, n, n))
    for process, direction in zip(plant.turbulence, np.eye(n), strict=True):
        turbulence += ar_covariance(loop, process, direction[None])
    for line in plant.vibrations:
        direction = checked_direction(line, one)
        vibration += ar_covariance(loop, line.ar_model(one.frame_rate_hz), direction[None])
    return _make_budget(loop, turbulence, noise_factor, vibration, [])


def _make_budget(
    loop: ClosedLoop,
    turbulence: FloatArray,
    noise_factor: FloatArray,
    random_vibration: FloatArray,
    lines: list[ComplexArray],
) -> ResidualBudget:
    """Add what white noise of covariance ``factor factor'`` leaves."""
    shape = len(lines), loop.hardware.modes
    return ResidualBudget(
        turbulence_nm2=frozen_copy(turbulence),
        noise_nm2=frozen_copy(noise_covariance(loop, noise_factor)),
        random_vibration_nm2=frozen_copy(random_vibration),
        line_amplitudes_nm=np.array(lines, dtype=np.complex128).reshape(shape),
    )


def noise_covariance(loop: ClosedLoop, factor: FloatArray) -> FloatArray:
    """Covariance of the residual that white noise of covariance ``factor factor'`` leaves."""
    n, s = loop.hardware.modes, loop.system.balanced()
    B, D = s.B[:, n:] @ factor, s.D[:n, n:] @ factor
    root = np.hstack([s.C[:n] @ stationary_root(s.A, B), D])
    return np.asarray(root @ root.T)


def ar_covariance(loop: ClosedLoop, model: ARModel, directions: FloatArray) -> FloatArray:
    """Covariance of the residual that independent AR processes leave, one per direction."""
    require_loop_rate(model.frame_rate_hz, loop.hardware)
    total = np.zeros((loop.hardware.modes, loop.hardware.modes))
    for direction in directions:
        total += _directed_covariance(loop, model, direction)
    return total


def _directed_covariance(loop: ClosedLoop, model: ARModel, direction: FloatArray) -> FloatArray:
    n, s, order = loop.hardware.modes, loop.system.balanced(), model.order
    # the newest sample of the process, x(k), acts on frame k
    entry = np.zeros((s.n_states, order))
    entry[:, 0] = s.B[:, :n] @ direction
    A = np.block([[s.A, entry], [np.zeros((order, s.n_states)), model.companion]])
    drive = np.zeros((len(A), 1))
    drive[s.n_states] = model.driving_rms_nm
    C = np.hstack([s.C[:n], np.zeros((n, order))])
    C[:, s.n_states] = s.D[:n, :n] @ direction
    root = C @ stationary_root(A, drive)  # what is left of a line is a small part of it
    return np.asarray(root @ root.T)


def _spectrum_covariance(
    loop: ClosedLoop, spectrum: Spectrum, modes: tuple[int, ...]
) -> FloatArray:
    """Integrate the residual's spectrum over (0, Nyquist), adaptively."""

    def density(frequency: FloatArray) -> FloatArray:
        response = loop.sensitivity(frequency)[:, :, list(modes)]
        power = np.real(np.einsum("fij,fkj->fik", response, response.conj()))
        return np.asarray(spectrum_density(spectrum, frequency)[:, None, None] * power)

    nyquist = loop.hardware.frame_rate_hz / 2
    edges = np.concatenate([resonance_edges(loop), breakpoints_below(spectrum, nyquist)])
    return adaptive_integral(density, np.unique(edges))


def resonance_edges(loop: ClosedLoop) -> FloatArray:
    """Panels of (0, Nyquist) [Hz] for a loop."""
    return panel_edges(loop.system.poles, loop.hardware.frame_rate_hz)


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
