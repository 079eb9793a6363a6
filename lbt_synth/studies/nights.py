"""One design for several nights of a loop, and what the design of one night costs on the others.

The variance that a linear controller leaves is linear in the spectra of disturbance and noise. So
where the nights have one sensor gain, the filter for the mean of their spectra leaves the least
mean variance. Each night counts in units of what its own design leaves: the mean is of ratios.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, LbtSynthError, ProblemError, SynthesisError
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
from lbt_synth.methods.method import DesignInputs
from lbt_synth.methods.registry import default_method, method_named, record_methods
from lbt_synth.methods.request import design_request
from lbt_synth.models.plant.tip_tilt import mean_plant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import FloatArray, choice

ALL = "all nights"  # the design for all of them
_LOOP = ("axes", "frame_rate_hz", "delay_frames", "diameter_m", "mirror")  # facts of one loop


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NightsDesign:
    """Controllers for several nights of one loop: of each night alone, and one for all of them."""

    nights: Mapping[str, RecordedDesign]
    designs: Mapping[str, Design]  # those of the nights, then that for all if one holds for all
    # of each design by the model of each night [nm rms over all axes]; nan where the loop is
    # unstable at a sensor gain that the night allows
    residual_nm: Mapping[str, Mapping[str, float]]
    notes: tuple[str, ...]

    def worst(self, name: str) -> tuple[float, str]:
        """Return the largest variance of a design over that of a night's own, and the night."""
        own = {night: self.residual_nm[night][night] for night in self.nights}
        ratios = ((nm / own[night], night) for night, nm in self.residual_nm[name].items())
        return max((np.inf if np.isnan(ratio) else ratio**2, night) for ratio, night in ratios)

    @property
    def name(self) -> str:
        """The design whose worst night is the best, that for all nights if they are equal."""
        return min(reversed(list(self.designs)), key=lambda name: self.worst(name)[0])

    @property
    def design(self) -> Design:
        """That design."""
        return self.designs[self.name]

    @property
    def verdict(self) -> tuple[str, str]:
        """What the design of one night alone costs at worst, and what that for all nights does."""
        alone = sorted(self.nights, key=self.worst)
        stable = [night for night in alone if self.worst(night)[0] < np.inf]
        told = dict.fromkeys([n for n in alone if n not in stable][:2] + stable[-1:] + stable[:1])
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
        ``accept_record``, ``command_scale_known``, ``separate_axes``, ``lowest_line_hz`` and
        ``most_lines`` of :func:`design_from_record`.

    Returns
    -------
    NightsDesign
        The design, those of each night, and the residual of each on each night; ``verdict`` says
        which it is, and why.

    Raises
    ------
    ProblemError
        If there are less than two nights, or they are not of one loop.
    CertificateError
        If no design is stable on all nights.
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
    >>> made = lbt.studies.design_from_nights(nights)
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
    residual_nm = {night: _residuals_nm(design, made) for night, design in designs.items()}
    for night, design in designs.items():
        if np.isfinite([*residual_nm[night].values()]).all():
            designs[night] = _assume_all_nights(night, design, made)
    notes = [
        f"{'warning: ' * note.startswith('warning: ')}{night}: {note.removeprefix('warning: ')}"
        for night, recorded in made.items()
        for note in (*recorded.notes, *recorded.model.notes)
    ]
    weights = [residual_nm[night][night] ** -2 for night in made]
    gains = np.array([recorded.gains for recorded in made.values()])

    def build(added_nm: FloatArray) -> Design:
        plants = [noisier(recorded.model, added_nm).plant() for recorded in made.values()]
        return design_request(chosen, {}).build(DesignInputs(plant=mean_plant(plants, weights)))

    try:
        design, _, note = design_for_gains(
            made[night].model,
            build,
            np.stack([gains[..., 0].min(axis=0), gains[..., 1].max(axis=0)], axis=1),
            command_scale_known=options.get("command_scale_known") or not np.ptp(gains, -1).any(),
        )
    except SynthesisError as error:
        notes.insert(0, f"no design for all nights: {str(error).rstrip('.')}")
    else:
        assumed = [
            f"{night}: {assumption}"
            for night, recorded in made.items()
            for assumption in recorded.design.assumptions
            if not assumption.startswith(GAINS_LIE)
        ]
        notes[:0] = [note] * bool(note)
        designs[ALL] = replace(design, assumptions=(*assumed, *design.assumptions))
        residual_nm[ALL] = _residuals_nm(design, made)
    best = NightsDesign(nights=made, designs=designs, residual_nm=residual_nm, notes=tuple(notes))
    if best.worst(best.name)[0] == np.inf:
        alone, _ = best.verdict
        raise CertificateError(f"no design is stable on all nights. {alone} Leave a night out.")
    return best


def _assume_all_nights(night: str, design: Design, nights: Mapping[str, RecordedDesign]) -> Design:
    """Return the design of a night with the sensor gains of all nights, at which it is stable."""
    gains = np.concatenate([recorded.gains for recorded in nights.values()])
    if not np.ptp(gains):  # it is known
        return design
    intervals = (dict.fromkeys(f"{end:.3g}" for end in ends) for ends in gains)
    texts = listing_text([*dict.fromkeys(map(" to ".join, intervals))])
    return replace(
        design,
        assumptions=(
            f"the sensor gain is one that a night allows: {texts}; the loop is stable at all of "
            "these",
            *(f"{night}: {assumption}" for assumption in design.assumptions),
        ),
    )


def _residuals_nm(design: Design, nights: Mapping[str, RecordedDesign]) -> dict[str, float]:
    """Return what a design leaves by the model of each night, nan where it is unstable."""
    residual_nm = dict.fromkeys(nights, np.nan)
    for name, night in nights.items():
        loop = design.close(night.model.hardware)
        if loop.is_stable and unstable_gains(design, night.gains) is None:
            residual_nm[name] = float(residual_budget(loop, night.model.plant()).rms_nm)
    return residual_nm


def require_one_loop(nights: Mapping[str, LoopRecord]) -> None:
    """Refuse less than two nights, and nights that are not of one loop."""
    if len(nights) < 2:
        raise ProblemError(
            f"nights must be at least two; got {len(nights)}. Try design_from_record for one."
        )
    (first, record), *others = nights.items()
    for (name, other), fact in product(others, _LOOP):
        if (got := getattr(other, fact)) != (expected := getattr(record, fact)):
            raise ProblemError(
                f"{name} has {fact}={got}, and {first} {fact}={expected}: one design is for the "
                f"nights of one loop. Say what is right, or leave {name} out."
            )
