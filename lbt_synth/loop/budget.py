"""The exact residual of loops, by origin: turbulence, vibrations, noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.linear.quadrature import adaptive_integral, gauss_panels, graded_edges
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.loop.ensemble import (
    EnsembleVibration,
    LoopEnsemble,
    ensemble_vibration,
)
from lbt_synth.loop.evaluator import (
    STILL,
    Evaluator,
    Matrices,
    close_loops,
    loop_evaluator,
    period_roots,
    process_poles,
)
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    LoopHardware,
    SinusoidalVibration,
    Spectrum,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.loop_hardware import require_loop_rate
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.sensor_suite import Motion, Motions, checked_motions
from lbt_synth.models.spectra import breakpoints_below, spectrum_density, spectrum_groups
from lbt_synth.models.vibration import checked_direction, sampled_lines
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact, fact_table, facts
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    IntArray,
    frozen_copy,
    read_only,
    require_instance,
)

_NODES = 6  # of a panel of a spectrum, whose power they have to 1e-6
_TOGETHER = 2048  # loops with the same frequencies: as many as repay their panels
_COVARIANCES = ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "within_nm2")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualBudget(Summarised):
    """Stationary residual of a loop, by origin; of p loops, all have a first axis (p,).

    Covariances are over the modes [nm^2], and of means over the hold of a command but for
    ``within_nm2``, of what moves within it.
    """

    turbulence_nm2: FloatArray  # (n, n)
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    within_nm2: FloatArray  # zero in means over frames
    line_amplitudes_nm: ComplexArray  # that each sinusoid leaves on each mode, (s, n)
    stable: Any = True  # what an unstable loop leaves is nan

    def _brief(self) -> str:
        modes, loops = self.noise_nm2.shape[-1], self.noise_nm2.shape[:-2]
        if loops:
            return f"{loops[0]} loops, {modes} modes"
        return f"{nm_text(self.rms_nm, '.4g')} rms, {modes} modes"

    def _summarise(self) -> Summary:
        headings = {
            "rms_nm": "residual",
            "turbulence_nm": "  turbulence",
            "vibration_nm": "  vibrations",
            "noise_nm": "  noise",
            "within_nm": "  within frames",
        }
        nm = {"unit": "nm rms", "format": ".1f"}
        named = {name: fact(getattr(self, name), text, **nm) for name, text in headings.items()}
        rows = facts(**named)
        return Summary(tables=[fact_table("Residual", rows)])

    @property
    def gaussian_nm2(self) -> FloatArray:
        """Covariance of all that is Gaussian [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def vibration_nm2(self) -> FloatArray:
        """Covariance of all vibrations, the sinusoids by their mean power [nm^2]."""
        a = self.line_amplitudes_nm
        return frozen_copy(self.random_vibration_nm2 + np.real(transpose(a) @ a.conj()) / 2)

    @property
    def total_nm2(self) -> FloatArray:
        """Covariance of the residual [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def rms_nm(self) -> Any:
        """Residual over all modes [nm rms]."""
        return _rms(self.total_nm2)

    @property
    def turbulence_nm(self) -> Any:
        """Residual turbulence over all modes [nm rms]."""
        return _rms(self.turbulence_nm2)

    @property
    def vibration_nm(self) -> Any:
        """Residual vibration over all modes [nm rms]."""
        return _rms(self.vibration_nm2)

    @property
    def noise_nm(self) -> Any:
        """Propagated noise over all modes [nm rms]."""
        return _rms(self.noise_nm2)

    @property
    def within_nm(self) -> Any:
        """What moves within frames over all modes, which no command follows [nm rms]."""
        return _rms(self.within_nm2)


def _rms(covariance: FloatArray) -> Any:
    root = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    return root if root.ndim else float(root)


def residual_budget(
    loop: ClosedLoop, truth: Truth | TipTiltPlant, *, frame_means: bool = False
) -> ResidualBudget:
    """Exact stationary residual of a loop under a truth, as the camera sees it.

    Parameters
    ----------
    loop : ClosedLoop
        The loop; its sensor gain must be the truth's.
    truth : Truth or TipTiltPlant
        Disturbances. Where a plant's model is the truth, each mode has its own turbulence, and the
        processes are of means over frames; its turbulence, vibrations and noise enter any loop.
    frame_means : bool, optional
        Whether the phase of a frame is one number, as in a simulator that steps by frames. What
        moves within a frame is then left out, and rms and spectra are those of these numbers.

    Returns
    -------
    ResidualBudget
        Covariances by origin; means over the period of several sensors.

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
    >>> loop = lbt.close_loop(path, lazy)
    >>> budget = lbt.residual_budget(loop, lbt.Truth(turbulence=None, noise_nm=3.0))
    >>> round(budget.noise_nm**2, 9)
    3.0

    Of a sinusoid of 20 Hz, ``1 - sinc^2(20/800)`` of the power moves within the frames:

    >>> line = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797, direction=(1,))
    >>> shake = lbt.Truth(turbulence=None, vibrations=(line,))
    >>> round(lbt.residual_budget(loop, shake).within_nm, 1)
    36.1
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    if not hasattr(truth, "entering"):
        require_instance(truth, Truth)
    hardware, n = loop.hardware, loop.hardware.modes
    turbulence, vibrations, noise = truth.entering(hardware, sensor_gain=loop.sensor_gain)
    motions: Motions = ({},) * len(vibrations)  # no channel is read
    if loop.reads_others:
        motions = checked_motions(truth.motions, hardware.suite, len(vibrations))
    rows = loop_evaluator(loop, in_image=not frame_means)
    lines, seen = [], np.zeros((2, n, n))
    for line, motion in zip(vibrations, motions, strict=True):
        if isinstance(line, Vibration) and _moved_rows(loop, motion):
            seen += _of_seen(loop, rows, line, motion)
        else:
            lines.append(_one_line(loop, line, motion))
    budget = residual_of_parts(
        [rows],
        turbulence,
        lines,
        _noise_factor(loop, noise)[None],
        hardware=hardware,
        of_means=frame_means or truth.is_of_means,
    )
    # what repeats with the period turns one sinusoid into several
    amplitudes = np.fft.fft(budget.line_amplitudes_nm, axis=0) / rows.phases
    means = {name: getattr(budget, name).mean(axis=0) for name in _COVARIANCES}
    means["random_vibration_nm2"] += seen[0]
    means["within_nm2"] += seen[1]
    covariances = {name: read_only(covariance) for name, covariance in means.items()}
    return ResidualBudget(**covariances, line_amplitudes_nm=read_only(amplitudes.reshape(-1, n)))


def random_density(
    loop: ClosedLoop, truth: Truth, frequency_hz: FloatArray, *, in_image: bool
) -> FloatArray:
    """One-sided spectrum of what is random in the residual, (f, n) [nm^2/Hz].

    It is of means over frames, or of the image: motion within a hold has its cause's frequency.
    """
    n, rate = loop.hardware.modes, loop.hardware.frame_rate_hz
    turbulence, vibrations, noise = truth.entering(loop.hardware, sensor_gain=loop.sensor_gain)
    origins = [(spectrum, np.eye(n)[:, modes], 1.0) for spectrum, modes in turbulence]
    for line in vibrations:
        if isinstance(line, Vibration):
            along = np.array(checked_direction(line, loop.hardware))[:, None]
            origins.append((line.ar_model(rate), along, np.sinc(line.frequency_hz / rate) ** 2))
    rows, factor = loop_evaluator(loop, in_image=in_image), _noise_factor(loop, noise)
    seen = replace(rows, B=rows.B[..., n:] @ factor, D=rows.D[..., n:] @ factor).system()
    response = seen.phase_response(frequency_hz)  # (f, phases, pieces n, p)
    pieces = np.abs(response.reshape(*response.shape[:2], -1, n, factor.shape[1])) ** 2
    total = 2 / rate * np.einsum("g,ftgip->fi", (rows.hold or STILL).weights, pieces)
    powers: dict[bytes, FloatArray] = {}  # that origins leave by an entry, the same for many
    for spectrum, entry, share in origins:
        density = share * spectrum_density(spectrum, frequency_hz)
        if isinstance(spectrum, ARModel) == in_image:  # a process is one of means over frames
            density *= np.sinc(frequency_hz / rate) ** (-2 if in_image else 2)
        if (key := entry.tobytes()) not in powers:
            powers[key] = np.einsum("hiift->fi", rows.powers(entry[None])(frequency_hz))
        total += powers[key] * density[:, None]
    return np.asarray(total / rows.phases)


def residual_spectrum(
    loop: ClosedLoop, truth: Truth, step_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Return multiples (f,) of a step, and the mean spectrum of the image about each, (f, n).

    It is one-sided [nm^2/Hz]; its sums times the step are the residual of the budget.
    """
    if loop.reads_others:
        raise ProblemError("a spectrum is of a loop that reads its own sensor alone.")
    loop.require_stable()
    rate = loop.hardware.frame_rate_hz
    frequency_hz = step_hz * np.arange(1, round(rate / 2 / step_hz) + 1)
    ends = np.array([0.0, *(frequency_hz[:-1] + step_hz / 2), rate / 2])
    edges, power = [ends, resonance_edges(loop)], np.zeros((ends.size - 1, loop.hardware.modes))
    for spectrum, _ in truth.turbulence_groups(loop.hardware.modes):
        edges.append(breakpoints_below(spectrum, rate / 2))
    for line in truth.vibrations:
        if isinstance(line, Vibration):
            poles = process_poles(line.ar_model(rate).coefficients[None]).ravel()
            edges.append(graded_edges(poles) * rate / 2)
        else:
            alone = replace(truth, turbulence=None, noise_nm=0.0, vibrations=(line,))
            covariance = residual_budget(loop, alone).total_nm2
            power[np.searchsorted(ends, line.frequency_hz) - 1] += np.diag(covariance)
    nodes, weights = gauss_panels(np.unique(np.hstack(edges)), _NODES)
    density = random_density(loop, truth, nodes, in_image=True)
    np.add.at(power, np.searchsorted(ends, nodes) - 1, weights[:, None] * density)
    return np.asarray(frequency_hz), power / step_hz


def residual_of_parts(
    parts: Sequence[Evaluator],
    turbulence: Sequence[tuple[Spectrum, list[int]]],
    lines: Sequence[EnsembleVibration],
    noise: FloatArray,
    *,
    hardware: LoopHardware,
    of_means: bool,
) -> ResidualBudget:
    """Return what k loops leave, whose independent parts are evaluated one by one.

    A line shakes the modes of one part. Each turbulence comes with its modes, the noise is a factor
    (k or 1, q, w) of its covariance, and the numbers of a line are (k or 1). ``of_means`` says of
    what the rms of a resonance is.
    """
    k, modes, rate = len(parts[0].start), hardware.modes, hardware.frame_rate_hz
    for spectrum, _ in turbulence:
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    air, shot, shaken = np.zeros((3, k, 2, modes, modes))  # of means, and within
    for part in parts:
        # what reaches equal parts alike is evaluated once, and no noise leaves nothing
        equal: dict[object, FloatArray] = {b"": np.zeros(())}
        for some, inputs in zip(part.modes, part.measurements, strict=True):
            at = np.s_[:, :, some[:, None], some]
            factor = noise[:, inputs]
            factor = factor[..., np.any(factor, axis=(0, 1))]
            if factor.tobytes() not in equal:
                equal[factor.tobytes()] = part.of_noise(factor)
            shot[at] += equal[factor.tobytes()]
            for i, (spectrum, reached) in enumerate(turbulence):
                columns = np.flatnonzero(np.isin(some, reached))
                key = i, *columns.tolist()
                if key not in equal and columns.size:
                    entry = np.eye(some.size)[None, :, columns]
                    equal[key] = part.of_turbulence(spectrum, entry)
                air[at] += equal.get(key, 0.0)
    amplitudes: list[ComplexArray] = []
    alike: dict[object, FloatArray] = {}  # of lines on other modes of equal parts
    for line in lines:
        pairs = ((part, some) for part in parts for some in part.modes)
        part, some = next(pair for pair in pairs if np.any(line.direction[:, pair[1]]))
        at, along = np.s_[:, :, some[:, None], some], line.direction[:, some]
        f = line.frequency_hz / rate
        if line.damping is not None:
            rms_nm = line.rms_nm * (1.0 if of_means else np.sinc(f))
            numbers = line.frequency_hz, line.damping, rms_nm, rate, line.sections
            coefficients, driving_nm = sampled_lines(*numbers)
            same = (id(part), coefficients.tobytes(), driving_nm.tobytes(), along.tobytes())
            if same not in alike:
                alike[same] = part.of_process(coefficients, driving_nm, along[..., None])
            shaken[at] += alike[same]
            continue
        entry = np.zeros((len(f), part.B.shape[2]), dtype=np.complex128)
        entry[:, : some.size] = along
        if line.readings is not None:
            entry[:, some.size :] = line.readings
        amplitude = np.zeros((k, modes), dtype=np.complex128)
        size_nm = np.sqrt(2) * line.rms_nm[:, None]
        amplitude[:, some], within = part.of_sinusoids(np.broadcast_to(f, k), size_nm * entry)
        shaken[:, 1, some[:, None], some] += within
        amplitudes.append(amplitude)
    return ResidualBudget(
        turbulence_nm2=air[:, 0],
        noise_nm2=shot[:, 0],
        random_vibration_nm2=shaken[:, 0],
        within_nm2=air[:, 1] + shot[:, 1] + shaken[:, 1],
        line_amplitudes_nm=np.array(amplitudes, np.complex128).reshape(-1, k, modes).swapaxes(0, 1),
    )


def _of_loops(turbulence: Spectrum, rows: IntArray) -> Spectrum:
    """Return the turbulence of some loops."""
    if isinstance(turbulence, Atmosphere | ARModel) and turbulence.count > 1:
        return turbulence.take(rows)
    return turbulence


def ensemble_residuals(
    matrices: Matrices, hardware: LoopHardware, ensemble: LoopEnsemble, *, frame_means: bool = False
) -> ResidualBudget:
    """Return what controllers ``A, B, C, D`` leave, (1 or p, ., .) each, in many loops (p,).

    Unstable loops leave nan.
    """
    noise, n, p = ensemble.noise(hardware), hardware.modes, ensemble.loops
    turbulence = spectrum_groups(ensemble.turbulence_of(n))
    lines = ensemble.lines(hardware)
    delays = hardware.delay_frames if ensemble.delay_frames is None else ensemble.delay_frames
    stable, groups = close_loops(
        matrices,
        hardware,
        np.broadcast_to(ensemble.sensor_gain, (p,)),
        np.broadcast_to(delays, (p,)),
        in_image=not frame_means,
        together=[np.any(line.direction, axis=0) for line in lines],
    )
    sinusoids = sum(line.damping is None for line in lines)
    whole = {name: np.full((p, n, n), np.nan) for name in _COVARIANCES}
    amplitudes = np.full((p, sinusoids, n), np.nan, dtype=np.complex128)
    for loops, parts in groups:
        # those next to instability need short panels
        radii = np.max(np.abs(np.concatenate([part.roots for part in parts], axis=1)), axis=1)
        order = np.argsort(radii, kind="stable")
        order = order[stable[loops[order]]]
        for first in range(0, order.size, _TOGETHER):
            some = order[first : first + _TOGETHER]
            rows = loops[some]
            budget = residual_of_parts(
                [part.take(some) for part in parts],
                [(_of_loops(air, rows), modes) for air, modes in turbulence],
                [line.take(rows) for line in lines],
                noise[rows],
                hardware=hardware,
                of_means=frame_means or ensemble.of_means,
            )
            for name, covariances in whole.items():
                covariances[rows] = getattr(budget, name)
            amplitudes[rows] = budget.line_amplitudes_nm
    return ResidualBudget(**whole, line_amplitudes_nm=amplitudes, stable=read_only(stable))


def model_covariances(loop: ClosedLoop, plant: TipTiltPlant) -> FloatArray:
    """Return covariances of mean residual and all readings in a plant, at each phase, (N, n+q, .).

    All processes of the plant drive the loop as one.
    """
    _, _, C, D = loop.system.stacks()
    n, p = loop.hardware.modes, plant.n_measurements
    rows = [*range(n), *range(C.shape[1] - p, C.shape[1])]
    every = replace(loop_evaluator(loop, in_image=False), C=C[:, rows], D=D[:, rows])
    turbulence = [ar_process(model) for model in plant.turbulence]
    shaken = [_shaken(loop, *pair) for pair in zip(plant.vibrations, plant.motions, strict=True)]
    processes = [*turbulence, *(process for process, _ in shaken)]
    entries = [np.eye(loop.system.B.shape[-1])[:, : len(turbulence)], *(e for _, e in shaken)]
    stacks = zip(*(_phases_of(every, process) for process in processes), strict=True)
    A, B, C = (np.array([block_diag(*one) for one in zip(*kind, strict=True)]) for kind in stacks)
    driven = every.driven(A, B, C, np.hstack(entries)[None])
    factor = _noise_factor(loop, plant.own_noise_factor)
    noise, direct = every.B[..., n:] @ factor, every.D[..., n:] @ factor
    below = np.zeros((len(noise), A.shape[1], noise.shape[2]))
    drive = np.concatenate([driven.B, np.concatenate([noise, below], axis=1)], axis=2)
    return replace(
        driven, B=drive, D=np.concatenate([driven.D, direct], axis=2)
    ).output_covariances()


def _one_line(
    loop: ClosedLoop, line: Vibration | SinusoidalVibration, motion: Mapping[str, Motion]
) -> EnsembleVibration:
    """Return a line as one loop meets it, with what channels read of a sinusoid."""
    hardware, n = loop.hardware, loop.hardware.modes
    readings = np.zeros(loop.system.B.shape[-1] - n, dtype=np.complex128)
    sensors = {name: s for s in hardware.suite.accelerometers for name in s.channels}
    for row, name in _moved_rows(loop, motion):
        if name not in loop.blind:
            swing = sensors[name].swing(motion[name], line.frequency_hz, hardware)
            readings[row - n] = swing
    along = checked_direction(line, hardware)
    return replace(ensemble_vibration(line), direction=along, readings=readings).of_loops(1)


def _of_seen(
    loop: ClosedLoop, rows: Evaluator, line: Vibration, motion: Mapping[str, Motion]
) -> FloatArray:
    """Return what a line leaves that channels read, too, (2, n, n)."""
    process, entry = _shaken(loop, line, motion)
    n, rate = loop.hardware.modes, loop.hardware.frame_rate_hz
    driven = rows.driven(*_phases_of(rows, process), entry[None])
    hold, along = rows.hold or STILL, entry[:n, :1]
    out = np.zeros((2, n, n))
    if rows.hold is None:
        out[0] = driven.output_covariances().mean(axis=0)
    if not rows.in_image:
        return out

    def density(f_hz: FloatArray) -> FloatArray:
        """Return the powers (f, 2, n, n) of the mean, and within."""
        f = f_hz / rate
        mean = process.phase_response(f_hz)[:, :1, 0]  # (f, 1, drives), of each phase
        moving = mean / np.sinc(f)[:, None, None]
        means = hold.phase_means(f) * np.exp(-1j * np.pi * f)[:, None]
        rest = 1 - np.abs(means) ** 2 @ hold.weights
        power = np.sum(np.abs(moving) ** 2, axis=(1, 2))
        left = np.zeros((f.size, 2, n, n))
        left[:, 1] = (power * rest)[:, None, None] * (along @ along.T)
        if rows.hold is not None:
            response = driven.system().phase_response(f_hz)
            positions = response.reshape(*response.shape[:2], -1, n, response.shape[-1])
            phase = means[:, None, :, None, None] * moving[:, :, None, None] * along
            of_mean = np.einsum("g,ftgid->ftid", hold.weights, phase - positions)
            apart, scale = phase - positions - of_mean[:, :, None], 1 / response.shape[1]
            left[:, 0] = scale * np.real(np.einsum("ftid,ftjd->fij", of_mean, of_mean.conj()))
            left[:, 1] += scale * np.real(
                np.einsum("g,ftgid,ftgjd->fij", hold.weights, apart, apart.conj())
            )
        return 2 / rate * left

    roots = np.concatenate([rows.roots.ravel(), period_roots(process.poles, process.period)])
    return out + adaptive_integral(density, graded_edges(roots) * rate / 2)


def _phases_of(rows: Evaluator, process: StateSpace) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B and C of a process at each phase of a loop."""
    A, B, C, _ = (stack[np.arange(rows.phases) % process.period] for stack in process.stacks())
    return A, B, C


def _moved_rows(loop: ClosedLoop, motion: Mapping[str, Motion]) -> list[tuple[int, str]]:
    """Return the inputs of a loop at which channels read a line, and the channels, in order."""
    rows, n = loop.hardware.suite.rows(loop.hardware), loop.hardware.modes
    return [(n + rows[name].start, name) for name in loop.hardware.suite.channels if name in motion]


def _shaken(
    loop: ClosedLoop, line: Vibration, motion: Mapping[str, Motion]
) -> tuple[StateSpace, FloatArray]:
    """Return a line as a process, and how it enters a loop."""
    hardware, moved = loop.hardware, _moved_rows(loop, motion)
    entry = np.zeros((loop.system.B.shape[-1], 1 + len(moved)))
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    for column, (row, name) in enumerate(moved, start=1):
        entry[row, column] = name not in loop.blind
    if not moved:
        return ar_process(line.ar_model(hardware.frame_rate_hz)), entry
    return seen_vibration(line, motion, hardware.suite.accelerometers, hardware), entry


def ar_process(model: ARModel) -> StateSpace:
    """Return the system from white noise to a process."""
    drive, output = np.zeros((2, model.order, 1))
    drive[0], output[0] = model.driving_rms_nm, 1.0
    D = np.zeros((1, 1))
    return StateSpace(A=model.companion, B=drive, C=output.T, D=D, dt_s=1 / model.frame_rate_hz)


def _noise_factor(loop: ClosedLoop, own: FloatArray) -> FloatArray:
    """Return the square root of the noise of all that a loop reads, (q, p)."""
    if not loop.reads_others:
        return own
    suite = loop.hardware.suite
    noise = suite.noise_factor(own, loop.hardware.modes)
    noise[suite.marked(loop.blind, loop.hardware)] = 0.0
    return np.asarray(noise)


def resonance_edges(loop: ClosedLoop) -> FloatArray:
    """Panels of (0, Nyquist) [Hz] for a loop."""
    roots = period_roots(loop.system.poles, loop.system.period)
    return graded_edges(roots) * loop.hardware.frame_rate_hz / 2
