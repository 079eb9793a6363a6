"""What designs do where the loop is another: moved lines, gains, delays, a mirror, many modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.config import Config
from lbt_synth.design import Design, FilterDesign, hinf, integrator, kalman, lqg, mixed
from lbt_synth.design.mixed import central_filter, require_taps
from lbt_synth.design.modal import modal_filters, modal_gains
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, loop_margins
from lbt_synth.loop.closed_loop import require_matching_controller
from lbt_synth.loop.ensemble import LoopEnsemble, ensemble_vibration
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.methods.registry import MIXED, record_methods, reference_methods
from lbt_synth.methods.request import reference_design
from lbt_synth.models import (
    LoopHardware,
    TipTiltPlant,
    Truth,
    Vibration,
    modal_turbulence,
    pyramid_modal_noise_nm,
)
from lbt_synth.models.loop_hardware import LONGEST_DELAY
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.models.turbulence.ar_models import radial_orders
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.storage.rows import NM, PERCENT, Facts, fact, facts
from lbt_synth.storage.words import unstable_text
from lbt_synth.studies.grid import ensemble_columns, evaluate, loop_columns
from lbt_synth.studies.limits import LimitStudy, limits
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    choice,
    integer,
    number,
    read_only,
    real_array,
    require_instance,
)

FAMILIES = (MIXED.name, "central")
_GAINS_AT_ONCE = 64  # of a map: one sample, of some hundredths of a second
_CROWDING = 1.5  # above 1, points are denser near the least norm


def loop_row(
    method: str,
    error_hz: float,
    loop: ClosedLoop,
    truth: Truth,
    imaging: Imaging,
    *,
    frame_means: bool = False,
) -> Facts:
    """Return what the loop of a design leaves at a frequency error; nan where it is unstable."""
    numbers: dict[str, Any] = {"error_hz": error_hz, "method": method}
    numbers |= loop_columns(loop, truth, imaging, frame_means=frame_means)
    numbers["stable"] = loop.is_stable
    return facts(**{name: fact(value) for name, value in numbers.items()})


def robustness(
    plant: TipTiltPlant,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Sequence[float],
    methods: Sequence[str] | None = None,
    gamma_ratio: float = 1.2,
    executor: Executor | None = None,
) -> Iterator[Facts]:
    """Design at each frequency error and evaluate exactly against the same truth.

    Parameters
    ----------
    plant : TipTiltPlant
        Plant whose vibrations are moved.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    errors_hz : sequence of float
        True frequency less that of the model [Hz], of the vibration that moves most; the others
        move in proportion (``truth.frequency_errors_hz``).
    methods : sequence of str, optional
        Methods of synthesis that design for a plant; by default the Kalman and the H-infinity
        filter.
    gamma_ratio : float, optional
        H-infinity bound as a multiple of each row's least gamma.
    executor : concurrent.futures.Executor, optional
        Runs the samples, in processes for example; it is left open. By default they run here.

    Yields
    ------
    Facts
        In the order of errors, then methods: ``error_hz`` and ``method``, ``strehl`` (a ratio in
        [0, 1]), ``residual_nm`` and its parts ``turbulence_nm``, ``vibration_nm``, ``noise_nm`` and
        ``within_nm``, of motion within frames [nm rms], and ``stable``; nan where it is not.

    Raises
    ------
    ProblemError
        If the plant has no vibration, or a value is out of range.
    SynthesisError
        If a design fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> loop = config.plant, config.truth, config.imaging
    >>> rows = list(lbt.studies.robustness(*loop, errors_hz=[0, 3], methods=["kalman"]))
    >>> rows[0].strehl > rows[1].strehl
    True
    """
    if not plant.vibrations:
        raise ProblemError(
            "a frequency error needs a vibration in the model; got a plant without any."
        )
    names = methods or [method.name for method in reference_methods(estimators_only=True)]
    for name in names:
        choice(name, "method", record_methods())
    errors, loop = [number(error, "errors_hz") for error in errors_hz], (plant, truth, imaging)
    samples = ((loop, error_hz, name, gamma_ratio) for error_hz in errors for name in names)
    yield from evaluate(_robustness_row, samples, executor)


def _robustness_row(
    loop: tuple[TipTiltPlant, Truth, Imaging], error_hz: float, method: str, gamma_ratio: float
) -> Facts:
    """Design for lines that an error has moved, and close the real loop."""
    plant, truth, imaging = loop
    shifts = [-truth.frequency_shift_hz(line.frequency_hz, error_hz) for line in plant.vibrations]
    moved = retuned_plant(plant, shifts, hold="driving")
    design = reference_design(method, moved, {"gamma_ratio": gamma_ratio})
    closed = design.close(plant.hardware, sensor_gain=truth.sensor_gain)
    return loop_row(method, error_hz, closed, truth, imaging)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobustnessMap:
    """Strehl ratio of a fixed design over errors in what it assumes about the loop."""

    errors_hz: FloatArray  # (e,): true less the design's [Hz], of the vibration that moves most
    sensor_gains: FloatArray  # (g,): real gains relative to the design's sensor matrix
    delay_errors_frames: FloatArray  # (d,): real delay less that of the design [frames]
    # (d, g, e): Strehl ratio in [0, 1]; nan where the loop is unstable, 0 where the image moves by
    # more than 160 times its width
    strehl: FloatArray
    residual_nm: FloatArray  # (d, g, e): of the modes [nm rms]; nan where the loop is unstable
    stable: BoolArray  # (d, g): whether the loop is, which a frequency error does not change

    def points(self, name: str) -> list[Facts]:
        """Return a row for each point of the map of a file."""
        axes = self.delay_errors_frames, self.sensor_gains, self.errors_hz
        names = ("delay_error_frames", "sensor_gain", "error_hz")
        return [
            facts(
                file=fact(name),
                **{n: fact(float(axis[i])) for n, axis, i in zip(names, axes, place, strict=True)},
                strehl=fact(float(strehl)),
                residual_nm=fact(float(self.residual_nm[place])),
                stable=fact(bool(self.stable[place[:2]])),
            )
            for place, strehl in np.ndenumerate(self.strehl)
        ]

    def worst_points(self, name: str, gain: int) -> Iterator[Facts]:
        """Yield the worst frequency error for each delay error at one of the sensor gains."""
        for i, delay in enumerate(self.delay_errors_frames):
            stable, strehls = bool(self.stable[i, gain]), self.strehl[i, gain]
            worst = int(np.argmin(strehls)) if stable else 0
            centre = strehls[self.errors_hz == 0]
            at_hz = self.errors_hz[worst] if stable else np.nan
            yield facts(
                file=fact(name, "file"),
                delay_error=fact(delay, "delay error", unit="frames", format="+g"),
                stable=fact(stable, "stable"),
                centre=fact(centre[0] if centre.size else np.nan, "Strehl at 0 Hz", **PERCENT),
                worst=fact(strehls[worst], "worst Strehl", **PERCENT),
                worst_hz=fact(at_hz, "at", unit="Hz", format="+.2f"),
            )


def robustness_map(
    design: Design,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: ArrayLike,
    sensor_gains: ArrayLike,
    delay_errors_frames: ArrayLike = (0.0,),
    hardware: LoopHardware | None = None,
    executor: Executor | None = None,
) -> RobustnessMap:
    """Evaluate one design exactly over frequency errors, sensor gains and delay errors.

    Parameters
    ----------
    design : Design
        The design, with a loop of one or two modes; its controller stays as it is.
    truth : Truth
        What the loop meets without any error. Its own sensor gain plays no part.
    imaging : Imaging
        The camera.
    errors_hz : (e,) array_like
        True frequency less that of the design [Hz], of the vibration that moves most. The others
        move in proportion (``truth.frequency_errors_hz``), and all keep their rms.
    sensor_gains : (g,) array_like
        Real sensor gains relative to the design's sensor matrix.
    delay_errors_frames : (d,) array_like, optional
        Real delay less that of the design [frames].
    hardware : LoopHardware, optional
        Loop to close; that of the design by default.
    executor : concurrent.futures.Executor, optional
        Runs the samples, in processes for example; it is left open. By default they run here.

    Returns
    -------
    RobustnessMap
        Strehl ratio, residual and stability at all combinations.

    Raises
    ------
    ProblemError
        If the design has no loop, or a value is out of its range or given twice.
    DimensionError
        If the loop has more than two modes, or a vibration another number of them.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> image = lbt.studies.robustness_map(
    ...     lbt.kalman(config.plant),
    ...     config.truth,
    ...     config.imaging,
    ...     errors_hz=[0, 3],
    ...     sensor_gains=[0.5, 1.0, 9.0],
    ... )
    >>> image.strehl.shape, image.stable[0].tolist()
    ((1, 3, 2), [True, True, False])
    >>> bool(image.strehl[0, 1, 0] > image.strehl[0, 1, 1])
    True
    """
    for value, kind in ((design, Design), (truth, Truth), (imaging, Imaging)):
        require_instance(value, kind)
    hardware = hardware or require_hardware(design, "a map")
    if hardware.modes > 2:
        raise DimensionError(
            f"a Strehl ratio of jitter takes 1 or 2 axes; got a loop of {hardware.modes} modes."
        )
    errors = _checked_axis(errors_hz, "errors_hz")
    gains = _checked_axis(sensor_gains, "sensor_gains", above=0)
    delays = _checked_axis(
        delay_errors_frames,
        "delay_errors_frames",
        at_least=1 - hardware.delay_frames,
        at_most=LONGEST_DELAY - hardware.delay_frames,
        hint=f"The design's delay of {hardware.delay_frames:g} frames and the error together must "
        f"lie between 1 and {LONGEST_DELAY}.",
    )
    if not truth.vibrations and (errors.size > 1 or errors[0] != 0):
        raise ProblemError(
            "a frequency error needs a vibration in the truth; got a truth without any."
        )
    for line in stationary_vibrations(truth.vibrations):
        checked_direction(line, hardware)
    moved_hz = np.array([truth.moved_hz(error) for error in errors.tolist()])  # (e, lines)
    require_matching_controller(hardware.own_sensor_alone(), as_controller(design))
    size = delays.size, gains.size, errors.size
    matrices = textbook_matrices([as_controller(design)])
    samples = (
        (
            matrices,
            hardware,
            LoopEnsemble(
                sensor_gain=np.repeat(some, errors.size),
                delay_frames=hardware.delay_frames + delay,
                noise_nm=truth.noise_per_measurement(hardware.n_measurements)[None],
                turbulence=truth.turbulence,
                vibrations=tuple(
                    replace(ensemble_vibration(line), frequency_hz=np.tile(line_hz, some.size))
                    for line, line_hz in zip(truth.vibrations, moved_hz.T, strict=True)
                ),
            ),
            imaging,
        )
        for delay in delays
        for some in np.array_split(gains, -(-gains.size // _GAINS_AT_ONCE))
    )
    stacks = list(evaluate(ensemble_columns, samples, executor))
    strehl, residual_nm, stable = (
        read_only(np.concatenate([stack[name] for stack in stacks]).reshape(size))
        for name in ("strehl", "residual_nm", "stable")
    )
    return RobustnessMap(
        errors_hz=errors,
        sensor_gains=gains,
        delay_errors_frames=delays,
        strehl=strehl,
        residual_nm=residual_nm,
        stable=read_only(stable[..., 0] == 1),
    )


def _checked_axis(values: ArrayLike, name: str, **bounds: Any) -> FloatArray:
    """Return the values of one axis of the map, each within its bounds and given once."""
    axis = real_array(values, name)
    if axis.ndim != 1 or axis.size == 0:
        raise DimensionError(f"{name} must be a list of at least one number; got {axis.shape}.")
    if np.unique(axis).size != axis.size:
        raise ProblemError(f"{name} must hold each value once; got {axis.tolist()}.")
    return read_only(np.array([number(value, name, **bounds) for value in axis]))


def compare_on_mirror(
    plant: TipTiltPlant,
    truth: Truth,
    imaging: Imaging,
    *,
    command_weight: float = 0.0,
    executor: Executor | None = None,
) -> LimitStudy:
    """Compare designs on a plant's moving mirror: what it costs to ignore its dynamics.

    They are the integrator with the best gain on this mirror, the Kalman filter for a mirror
    that settles at once, the same filter with the real positions taken out of its measurements,
    and the LQG, which also commands for the dynamics.
    """
    require_instance(plant, TipTiltPlant, "plant")
    hardware = plant.hardware
    regulated = lqg(plant, command_weight=command_weight)
    designs: dict[str, Design] = {
        "integrator, best gain": integrator(hardware, truth=truth),
        "kalman, settled mirror": kalman(replace(plant, hardware=replace(hardware, mirror=None))),
        "kalman, real positions": kalman(plant),
        regulated.method: regulated,
    }
    return limits(designs, hardware, truth, imaging, executor=executor)


def tradeoff(
    problem: EstimationProblem,
    *,
    points: int = 9,
    taps: int = 16,
    executor: Executor | None = None,
) -> Iterator[Facts]:
    """Return filters from the least norm to the least variance, and examine their loops.

    The levels run from the least gamma to the norm of the Kalman filter, at which all
    families meet.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; with a plant, each filter's loop is examined.
    points : int, optional
        Levels of the norm, at least 2.
    taps : int, optional
        Length of the mixed filters' impulse response.
    executor : concurrent.futures.Executor, optional
        Runs the samples, in processes for example; it is left open. By default they run here.

    Yields
    ------
    Facts
        In the order of levels, then families; each is designed when it is requested. ``design`` is
        the filter of a ``family``: "mixed", of the least variance of all with this norm, or
        "central", the H-infinity filter whose norm it is. ``gamma`` and ``rms`` are the norm and
        the standard deviation of its error, recomputed [nm], ``gamma_ratio`` is the norm over the
        least; ``gain_low``, ``gain_high`` and ``modulus`` are margins of its loop, nan without one.

    Raises
    ------
    ProblemError
        If a value is out of its range.
    SynthesisError
        If a design fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.EstimationProblem(
    ...     A=[[1.9, -0.99], [1.0, 0.0]],
    ...     B=[[1.0, 0.0], [0.0, 0.0]],
    ...     C=[[0.0, 1.0]],
    ...     D=[[0.0, 3.0]],
    ...     L=[[1.0, 0.0]],
    ... )
    >>> points = list(lbt.studies.tradeoff(line, points=3))[::2]  # the mixed ones
    >>> points[0].rms > points[1].rms > points[2].rms
    True
    """
    require_instance(problem, EstimationProblem)
    count = integer(points, "points", at_least=2)
    length = require_taps(taps)
    least, best = hinf(problem, route="riccati"), kalman(problem)
    spread = max(best.gamma / least.gamma_least, 1.0)
    levels = least.gamma_least * spread ** (np.linspace(0, 1, count) ** _CROWDING)
    ends: dict[int, FilterDesign] = {0: least, count - 1: best}
    samples = (
        (problem, family, ends.get(i, level), length, least.gamma_least)
        for i, level in enumerate(levels.tolist())
        for family in FAMILIES
    )
    yield from evaluate(_front_point, samples, executor)


def _front_point(
    problem: EstimationProblem,
    family: str,
    level: float | FilterDesign,
    taps: int,
    gamma_least: float,
) -> Facts:
    """Design a filter of a norm, unless it is at an end of the front, and examine its loop."""
    if isinstance(level, FilterDesign):
        design = level
    elif family == MIXED.name:
        design = mixed(problem, gamma=level, taps=taps)
    else:
        design = central_filter(problem, gamma=level)
    margins = None
    if design.hardware is not None:
        margins = loop_margins(close_loop(design.hardware, design.controller))
    names = ("gain_low", "gain_high", "modulus")
    gain_low, gain_high, modulus = (getattr(margins, name, np.nan) for name in names)
    deviation = {"unit": "nm", "format": ".2f"}
    return facts(
        family=fact(family, "filter"),
        gamma=fact(design.gamma, "norm", **deviation),
        gamma_ratio=fact(max(design.gamma / gamma_least, 1.0), "norm / least", format=".4f"),
        rms=fact(design.rms, "rms", **deviation),
        gain_low=fact(gain_low, "gain from", format=".3f"),
        gain_high=fact(gain_high, "gain to", format=".3f"),
        modulus=fact(modulus, "modulus margin", format=".3f"),
        design=fact(design),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalStudy:
    """What controllers leave of the turbulence in each of n modes."""

    turbulence_nm: FloatArray  # (n,): what comes in [nm rms]
    noise_nm: FloatArray  # (n,): per frame [nm]
    gains: FloatArray  # (n,): of the integrators
    residual_nm: Mapping[str, FloatArray]  # of integrators and of filters, (n,) [nm rms]

    def by_radial_order(self) -> Iterator[Facts]:
        """Yield a row for each radial order: root sums of squares over its modes."""
        radial = radial_orders(self.noise_nm.size)
        for order in np.unique(radial):
            which = radial == order
            turbulence_nm, optimised_nm, kalman_nm = (
                float(np.linalg.norm(series[which]))
                for series in (self.turbulence_nm, *self.residual_nm.values())
            )
            noise_nm = float(self.noise_nm[which][0])
            yield facts(
                radial_order=fact(int(order), "radial order"),
                modes=fact(int(which.sum()), "modes"),
                turbulence_nm=fact(turbulence_nm, "turbulence", **NM),
                noise_nm=fact(noise_nm, "noise per mode", unit="nm", format=".2f"),
                gain=fact(float(self.gains[which].mean()), "mean gain", format=".3f"),
                optimised_nm=fact(optimised_nm, "optimised gains", **NM),
                kalman_nm=fact(kalman_nm, "Kalman", **NM),
            )


def compare_modes(config: Config, modes: int) -> ModalStudy:
    """Compare integrators of the best gains with Kalman filters, for the first modes of a loop."""
    hardware, sensor_gain = config.hardware, config.settings.model.sensor_gain
    if config.atmosphere is None:
        reason = "the turbulence of hundreds of modes is computed from it"
        config.refuse_key("atmosphere", f"is missing: {reason}")
    air = modal_turbulence(config.atmosphere, modes=modes, frame_rate_hz=hardware.frame_rate_hz)
    for key, value in (("sensor.noise_nm", config.noise_nm), ("model.sensor_gain", sensor_gain)):
        if np.ndim(value):
            config.refuse_key(key, "must be one number for hundreds of modes; got one per axis")
    pyramid, noise_nm = config.settings.sensor.pyramid, np.full(modes, float(config.noise_nm))
    if pyramid is not None:
        modulation = pyramid.modulation_lambda_over_d
        noise_nm = pyramid_modal_noise_nm(
            float(config.noise_nm), modes=modes, modulation_lambda_over_d=modulation
        )
    lines = dict[int, list[Vibration]]()
    for line in config.plant.vibrations:  # each axis by itself
        for axis, share in enumerate(line.direction):
            if abs(share) > 1e-9:  # more than rounding
                tilted = replace(line, rms_nm=abs(share) * line.rms_nm, direction=(1.0,))
                lines.setdefault(axis, []).append(tilted)
    loop: dict[str, Any] = {"hardware": hardware, "noise_nm": noise_nm, "vibrations": lines}
    loop["sensor_gain"] = config.sensor_gain
    gains = modal_gains(air, **loop)
    return ModalStudy(
        turbulence_nm=air.rms_nm,
        noise_nm=noise_nm,
        gains=gains.gains,
        residual_nm={
            "integrators, optimised gains": gains.rms_nm,
            "Kalman filters": modal_filters(air, **loop).rms_nm,
        },
    )


def say_maps(maps: Mapping[str, RobustnessMap], real: int, where: str) -> list[str]:
    """Return where designs are unstable, and which keeps the highest Strehl ratio at worst."""
    counts = {name: np.count_nonzero(~grid.stable) for name, grid in maps.items()}
    unstable = sorted((name for name in maps if counts[name]), key=lambda name: -counts[name])
    verdict = []
    if unstable:
        most = f"{'up to ' * (len(unstable) > 1)}{counts[unstable[0]]}"
        pairs = f"{maps[unstable[0]].stable.size} pairs of a sensor gain and a delay error"
        verdict = [f"{unstable_text(unstable)} at {most} of {pairs} of a map."]
    lowest = {name: float(np.min(grid.strehl[:, real])) for name, grid in maps.items()}
    best = max(lowest, key=lambda name: np.nan_to_num(lowest[name]))  # nan is unstable
    if lowest[best] > 0:
        percent = f"{100 * lowest[best]:.1f} %"
        verdict.append(f"{best} keeps the highest Strehl ratio at worst over {where}, {percent}.")
    return verdict
