"""The robust design: vibrations anywhere in bands, an uncertain sensor gain, a margin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from lbt_synth.design.loop_shaping import ShapedDesign, noise_per_mode, shape
from lbt_synth.design.shaping.demands import (
    Demand,
    LoopErrors,
    ModulusMargin,
    MovingSensorGain,
)
from lbt_synth.design.shaping.objectives import Leaf, ResidualVariance, Total, VibrationBand
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import ProblemError
from lbt_synth.models import Spectrum, TipTiltPlant, Vibration
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING
from lbt_synth.validation import number, require_instance, sequence

_DELAY_ERROR = 0.1  # frames, at which a loop has to be stable: 100 us at 1 kHz


def robust(
    plant: TipTiltPlant,
    *,
    bands: Sequence[VibrationBand] | Sequence[Sequence[VibrationBand]] = (),
    sensor_gain: tuple[float, float] = (1.0, 1.0),
    moving_gain: bool = False,
    scenarios: Sequence[float] = (1.0,),
    modulus_margin: float = 0.45,
    delay_error_frames: float | None = None,
    turbulence: Spectrum | None = None,
    demands: Sequence[Demand] = (),
    functions: int = 60,
    pole: float = 0.7,
    states: int | None = 20,
    loss: float = 0.1,
) -> ShapedDesign:
    """Design one controller for vibrations anywhere in bands and an uncertain sensor gain.

    For each mode it minimises, summed over some sensor gains, the variance of turbulence and
    noise plus the worst residual of a vibration in each band; under a modulus margin at unit
    sensor gain, and stability for every sensor gain of an interval. ``config.design("robust")``
    makes one of the section ``design.robust`` of a configuration.

    Parameters
    ----------
    plant : TipTiltPlant
        Loop, noise and turbulence. The bands take the place of its vibrations, but for resonances
        with a damping above 0.1 that no band covers: these are disturbances like the turbulence.
    bands : sequence of VibrationBand, or one sequence per mode, optional
        Bands, each with the rms of its vibration. In one sequence, every mode may have all of
        them.
    sensor_gain : tuple of float, optional
        Interval of sensor gains, around 1, for which the loop stays stable.
    moving_gain : bool, optional
        Whether it also stays stable while the gain moves in that interval, at any speed.
    scenarios : sequence of float, optional
        Sensor gains whose residuals are added up.
    modulus_margin : float, optional
        Modulus margin at unit sensor gain.
    delay_error_frames : float, optional
        Error of the delay, late or early, at which the loop stays stable at every sensor gain of
        the interval [frames]. By default 0.1 where the mirror settles at once, and none for a
        mirror with dynamics.
    turbulence : Atmosphere, ARModel or TabulatedSpectrum, optional
        Spectrum of each mode instead of the plant's models.
    demands : sequence of demands, optional
        Further demands, as :class:`Specification` takes them.
    functions, pole, states, loss
        As :func:`shape`.

    Returns
    -------
    ShapedDesign
        Certified design.

    Raises
    ------
    ProblemError, InfeasibleError, NumericalError, CertificateError
        As :func:`shape`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=20.0, modes=1)
    >>> line = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100)
    >>> design = lbt.robust(plant, bands=[line], sensor_gain=(0.5, 1.2), functions=16, states=None)
    >>> low, high = lbt.loop.stable_sensor_gains(plant.hardware, design.controller)
    >>> low < 0.5 and high > 1.2
    True
    """
    require_instance(plant, TipTiltPlant, "plant")
    plant.require_own_sensor("robust")
    lines = _bands_per_mode(bands, plant.hardware.modes)
    gains = tuple(number(g, "scenarios", above=0) for g in sequence(scenarios, "scenarios"))
    if not gains:
        raise ProblemError("scenarios must name at least one sensor gain; got none.")
    ends = sequence(sensor_gain, "sensor_gain")
    if len(ends) != 2:
        raise ProblemError(f"sensor_gain must be (low, high); got {sensor_gain!r}.")
    low, high = ends
    further = sequence(demands, "demands")
    fixed: list[Demand] = [ModulusMargin(at_least=modulus_margin)]
    late = delay_error_frames
    if late is None:
        late = _DELAY_ERROR if plant.hardware.mirror is None else 0.0
    if late or ((low, high) != (1, 1) and not moving_gain):
        fixed.append(LoopErrors(low=low, high=high, delay_frames=late))
    if moving_gain and (low, high) == (1, 1):
        raise ProblemError("moving_gain needs the interval in which it moves; give sensor_gain.")
    if moving_gain:
        fixed.append(MovingSensorGain(low=low, high=high))
    deviations = noise_per_mode(plant.hardware, plant.R)
    by_mode: dict[object, Specification] = {}
    specifications = []
    each = zip(deviations.tolist(), plant.turbulence, lines, strict=True)
    for mode, (noise_nm, model, own) in enumerate(each):
        spectrum, wide = model if turbulence is None else turbulence, _uncovered(plant, mode, own)
        # equal modes share one specification, and are solved once
        key = f"{noise_nm:.9g}", id(spectrum), own, wide
        if key not in by_mode:
            air = ResidualVariance(turbulence=spectrum, noise_nm=noise_nm)
            terms: tuple[Leaf, ...] = (air, *_resonance_terms(plant, wide), *own)
            terms = tuple(replace(term, sensor_gain=g) for g in gains for term in terms)
            by_mode[key] = Specification(objective=Total(terms=terms), demands=(*fixed, *further))
        specifications.append(by_mode[key])
    path = plant.hardware
    return shape(path, specifications, functions=functions, pole=pole, states=states, loss=loss)


def _uncovered(
    plant: TipTiltPlant, mode: int, bands: tuple[VibrationBand, ...]
) -> tuple[Vibration, ...]:
    """Return the wide resonances of a mode that no band covers, with their rms on it."""
    return tuple(
        replace(line, rms_nm=line.rms_nm * abs(line.direction[mode]), direction=(1.0,))
        for line in plant.vibrations
        if line.damping > WIDE_DAMPING
        and line.direction[mode]
        and not any(
            band.low_hz <= line.frequency_hz <= band.high_hz and band.damping > line.damping / 2
            for band in bands
        )
    )


def _resonance_terms(
    plant: TipTiltPlant, resonances: tuple[Vibration, ...]
) -> Iterator[ResidualVariance]:
    """Yield the residual of each resonance, whose spectrum is known as that of turbulence is."""
    for line in resonances:
        process = line.ar_model(plant.hardware.frame_rate_hz)
        yield ResidualVariance(turbulence=process, noise_nm=0.0)


def _bands_per_mode(
    bands: Sequence[VibrationBand] | Sequence[Sequence[VibrationBand]], modes: int
) -> list[tuple[VibrationBand, ...]]:
    """Return the bands of each mode: those of all modes, or one sequence per mode."""
    given: tuple[Any, ...] = sequence(bands, "bands")
    nested = bool(given) and all(isinstance(own, list | tuple) for own in given)
    if nested and len(given) != modes:
        raise ProblemError(
            f"bands must be one sequence, or one per mode ({modes}); got {len(given)} of them."
        )
    out = [tuple(own) for own in given] if nested else [given] * modes
    for line in (line for own in out for line in own):
        require_instance(line, VibrationBand, "each of bands")
    return out
