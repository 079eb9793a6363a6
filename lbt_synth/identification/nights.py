"""One design for several nights of a loop, and what the design of one night costs on the others.

The variance that a linear controller leaves is linear in the spectra of disturbance and noise. So
where the nights have one sensor gain, the filter for the mean of their spectra leaves the least
mean variance. Each night counts in units of what its own design leaves: the mean is of ratios.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError, ProblemError, SynthesisError
from lbt_synth.identification.auto import (
    GAINS_LIE,
    RecordedDesign,
    design_for_gains,
    design_from_record,
    unstable_gains,
)
from lbt_synth.identification.prediction.regression import noisier
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.loop import residual_budget
from lbt_synth.methods.registry import default_method, method_named, record_methods
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models import TipTiltPlant, Vibration, tip_tilt_plant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import choice

ALL = "all nights"  # the design for all of them
_FACTS = {  # of one loop
    "axes": "number of axes",
    "frame_rate_hz": "frame rate [Hz]",
    "delay_frames": "delay [frames]",
    "diameter_m": "telescope diameter [m]",
    "mirror": "mirror",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NightsDesign:
    """A controller for several nights of one loop."""

    design: Design
    name: str  # all nights, or the night whose design alone has the better worst night
    nights: Mapping[str, RecordedDesign]  # model and design of each night
    # of each design, of a night or of all, by the model of each night [nm rms over all axes]; nan
    # where the loop is unstable at a sensor gain that the night allows
    residual_nm: Mapping[str, Mapping[str, float]]
    notes: tuple[str, ...]

    def worst(self, name: str) -> tuple[float, str]:
        """Return the largest variance of a design over that of a night's own, and the night."""
        return _worst(self.residual_nm, name)

    @property
    def verdict(self) -> tuple[str, str]:
        """What the design of one night alone costs at worst, and what that for all nights does."""
        alone = sorted(self.nights, key=self.worst)
        stable = [night for night in alone if self.worst(night)[0] < np.inf]
        told = dict.fromkeys([n for n in alone if n not in stable] + stable[-1:] + stable[:1])
        words = "; ".join(f"that of {night} {self._say(night)}" for night in told)
        first = f"The design of one night alone, on its worst night: {words}."
        if ALL not in self.residual_nm:
            return first, f"None holds for all nights; that of {self.name} alone is written."
        second = f"The design for all nights {self._say(ALL)} at worst"
        if self.name == ALL:
            return first, f"{second}, and is written."
        pairs = zip(*(self.residual_nm[name].values() for name in (ALL, self.name)), strict=True)
        worse = " on every night" * all(not one <= other for one, other in pairs)
        return first, f"{second}: worse{worse} than that of {self.name} alone, which is written."

    def _say(self, name: str) -> str:
        """Say what a design does on its worst night."""
        ratio, night = self.worst(name)
        if ratio == np.inf:
            return f"is unstable on {night}"
        leaves = f"leaves {ratio:.2f} times the variance of the night's own design on {night}"
        return f"{leaves} ({nm_text(self.residual_nm[name][night])} rms)"


def design_from_nights(
    nights: Mapping[str, LoopRecord],
    *,
    method: str | None = None,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> NightsDesign:
    """Design one controller for several nights of a loop, beside the design of each night alone.

    The design for all nights is that for the mean of their models, each weighted by the inverse of
    the variance that its own design leaves, and is stable at all sensor gains that the nights
    allow. Of all designs, the one is chosen whose worst night, relative to the night's own design,
    is the best.

    Parameters
    ----------
    nights : mapping of str to LoopRecord
        At least two records of one loop by their names. One that states its sensor gain keeps it.
    method : str, optional
        Method of synthesis that needs no more than a plant; the Kalman filter by default.
    progress : callable, optional
        Called with 1 after each of 3 steps a night.
    **options
        ``accept_record``, ``command_scale_known``, ``lowest_line_hz`` and ``most_lines`` of
        :func:`design_from_record`.

    Returns
    -------
    NightsDesign
        The design, those of each night, and the residual of each on each night; ``verdict`` says
        which it is, and why.

    Raises
    ------
    ProblemError
        If there are less than two nights, or they are not of one loop.
    LbtSynthError
        As :func:`design_from_record`; the message begins with the name of the night.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> ran, nights = lbt.integrator(path, gain=0.3).controller, {}
    >>> for hz in (38, 42):
    ...     line = lbt.Vibration(frequency_hz=hz, damping=0.005, rms_nm=50, direction=(1,))
    ...     truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    ...     run = lbt.simulate(ran, truth, hardware=path, frames=8000)
    ...     nights[f"{hz} Hz"] = lbt.identification.loop_record(
    ...         run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ...     )
    >>> made = lbt.identification.design_from_nights(nights)
    >>> made.name, made.worst("all nights")[0] < 1.2, made.worst("38 Hz")[0] > 2
    ('all nights', True, True)
    """
    chosen = default_method() if method is None else method
    choice(chosen, "method", [n for n in record_methods() if not method_named(n).of_record])
    require_one_loop(nights)
    made = dict[str, RecordedDesign]()
    for night, record in nights.items():
        options |= {"sensor_gain": record.stated_gain or None, "progress": progress}
        try:
            made[night] = design_from_record(record, method=chosen, **options)
        except LbtSynthError as error:
            error.args = (f"{night}: {error}",)
            raise
    designs = {night: recorded.design for night, recorded in made.items()}
    notes = [
        f"{'warning: ' * note.startswith('warning: ')}{night}: {note.removeprefix('warning: ')}"
        for night, recorded in made.items()
        for note in (*recorded.notes, *recorded.model.notes)
    ]
    try:
        known = options.get("command_scale_known", False)
        designs[ALL], note = _design_for_all(made, chosen, command_scale_known=known)
        notes = [note] * bool(note) + notes
    except SynthesisError as error:
        notes = [f"no design for all nights: {str(error).rstrip('.')}", *notes]
    residual_nm = {
        name: {night: _residual_nm(design, recorded) for night, recorded in made.items()}
        for name, design in designs.items()
    }
    best = min(reversed(designs), key=lambda name: _worst(residual_nm, name)[0])
    return NightsDesign(
        design=designs[best], name=best, nights=made, residual_nm=residual_nm, notes=tuple(notes)
    )


def _worst(residual_nm: Mapping[str, Mapping[str, float]], name: str) -> tuple[float, str]:
    """Return the largest ratio of a design, infinite where it is unstable, and its night."""
    own = {night: residual_nm[night][night] for night in residual_nm[name]}
    ratios = ((nm / own[night], night) for night, nm in residual_nm[name].items())
    return max((np.inf if np.isnan(ratio) else ratio**2, night) for ratio, night in ratios)


def _residual_nm(design: Design, night: RecordedDesign) -> float:
    """Return what a design leaves by the model of a night, nan where it is unstable."""
    loop = design.close(night.model.hardware)
    if not loop.is_stable or unstable_gains(design, night.gains) is not None:
        return np.nan
    return float(residual_budget(loop, night.model.plant()).rms_nm)


def _design_for_all(
    nights: Mapping[str, RecordedDesign], method: str, *, command_scale_known: bool
) -> tuple[Design, str]:
    """Return the design for the mean of nights that is stable at all their gains, and a note."""
    models = [night.model for night in nights.values()]
    weights = [_residual_nm(night.design, night) ** -2 for night in nights.values()]
    gains = np.array([night.gains for night in nights.values()])

    def build(noise: float) -> Design:
        plants = [noisier(model, noise).plant() for model in models]
        return design_request(method, {}).build(PlantInputs(plant=mean_plant(plants, weights)))

    allowed = np.stack([gains[..., 0].min(axis=0), gains[..., 1].max(axis=0)], axis=1)
    design, _, note = design_for_gains(
        models[0], build, allowed, command_scale_known=command_scale_known
    )
    assumed = [
        f"{name}: {assumption}"
        for name, night in nights.items()
        for assumption in night.design.assumptions
        if not assumption.startswith(GAINS_LIE)
    ]
    return replace(design, assumptions=(*assumed, *design.assumptions)), note


def mean_plant(plants: Sequence[TipTiltPlant], weights: Sequence[float]) -> TipTiltPlant:
    """Return the plant whose spectra are the weighted means of those of plants of one loop.

    Lines that overlap become one of their power, and the turbulence has the shape of that plant
    whose driving noise weighs most. The sensor gain is the geometric mean.
    """
    shares, hardware = np.array(weights) / np.sum(weights), plants[0].hardware
    gains = np.array([np.diag(plant.hardware.sensor) for plant in plants])
    gain = np.exp(np.mean(np.log(gains), axis=0))
    noises = [p.R * np.outer(gain / own, gain / own) for p, own in zip(plants, gains, strict=True)]
    air = []
    for models in zip(*(plant.turbulence for plant in plants), strict=True):
        powers = shares * [model.driving_rms_nm**2 for model in models]
        strongest = models[int(np.argmax(powers))]
        air.append(replace(strongest, driving_rms_nm=float(np.sqrt(np.sum(powers)))))
    lines = [
        replace(line, rms_nm=float(np.sqrt(share)) * line.rms_nm)
        for share, plant in zip(shares, plants, strict=True)
        for line in plant.vibrations
    ]
    return tip_tilt_plant(
        frame_rate_hz=hardware.frame_rate_hz,
        delay_frames=hardware.delay_frames,
        turbulence=air,
        vibrations=_merge(lines) or None,
        noise_nm=np.tensordot(shares, noises, 1),
        sensor_matrix=np.diag(gain),
        mirror=hardware.mirror,
    )


def _merge(lines: Sequence[Vibration]) -> list[Vibration]:
    """Return lines, those of a direction nearer than the half width of the wider one as one."""
    merged = list[Vibration]()
    for line in sorted(lines, key=lambda one: (one.direction, one.sections, one.frequency_hz)):
        last = merged[-1] if merged else line
        half_hz = max(one.damping * one.frequency_hz for one in (last, line))
        same = (last.direction, last.sections) == (line.direction, line.sections)
        if merged and same and line.frequency_hz - last.frequency_hz < half_hz:
            strong, weak = sorted((merged.pop(), line), key=lambda one: -one.rms_nm)
            rms_nm = float(np.hypot(strong.rms_nm, weak.rms_nm))
            move_hz = (weak.rms_nm / rms_nm) ** 2 * (weak.frequency_hz - strong.frequency_hz)
            line = replace(strong, frequency_hz=strong.frequency_hz + move_hz, rms_nm=rms_nm)
        merged.append(line)
    return merged


def require_one_loop(nights: Mapping[str, LoopRecord]) -> None:
    """Refuse less than two nights, and nights that are not of one loop."""
    if len(nights) < 2:
        raise ProblemError(
            f"nights must be at least two; got {len(nights)}. Try design_from_record for one."
        )
    (first, record), *others = nights.items()
    for name, other in others:
        for fact, words in _FACTS.items():
            expected, got = getattr(record, fact), getattr(other, fact)
            if got != expected:
                raise ProblemError(
                    f"{name} has the {words} {got}, and {first} {expected}: one design is for the "
                    f"nights of one loop. Say what is right, or leave {name} out."
                )
