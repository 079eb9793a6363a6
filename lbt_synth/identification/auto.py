"""A certified controller from a record, tested on data that it has not seen.

The Kalman filter is the default. It stays unless another method leaves clearly less on every third
of the test: one that wins on some parts only has won by what changed between them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.identification.commands.verdict import explain_commands, judge_fitted_gains
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.comparison import (
    PredictionTable,
    compare_on_record,
    stable_designs,
)
from lbt_synth.identification.prediction.residual import ResidualEstimate
from lbt_synth.identification.records.record import LEAST_SECONDS as LEAST_RECORD_SECONDS
from lbt_synth.identification.records.record import LoopRecord, require_length
from lbt_synth.identification.sensor_gains import (
    allowed_gains,
    design_for_gains,
    unstable_gains,
)
from lbt_synth.identification.stretches import split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, residual_budget
from lbt_synth.methods.registry import (
    default_method,
    gain_robust_method,
    method_named,
    record_methods,
)
from lbt_synth.methods.request import PlantInputs, design_request, option_owners
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import choice, require_instance

_DRIFT_SHARE = 0.3  # of the residual, that an offset may leave without a note
LEAST_SECONDS = 2 * LEAST_RECORD_SECONDS  # usable: half of it has to show a model
_SHORT_SECONDS = 15.0  # below, a note says what the record leaves open
_PARTS = 3  # of the test, on each of which another method has to win
_ERRORS = 2.0  # of the difference by which another method has to leave less than the default
_LEAST_SHARE = 0.02  # of the measured variance: 1 % of the rms, less than conditions change by


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedDesign(Summarised):
    """A controller designed from a record."""

    model: IdentifiedModel  # from all usable frames
    design: Design  # certified for this model
    half_model: IdentifiedModel  # from the first half of the usable frames
    # residuals on the second half: what ran, a design from the first half, references
    held_out: PredictionTable
    name: str  # row of the design in held_out, the title of its method
    notes: tuple[str, ...]  # warnings about the design

    @property
    def controller(self) -> Controller:
        """The controller of the design."""
        return self.design.controller

    def _brief(self) -> str:
        return f"{self.name}, {self.model.hardware._brief()}"

    def _summarise(self) -> Summary:
        """Return the facts of the design, and the notes."""
        summary = self.design._summarise()
        return replace(summary, notes=(*summary.notes, *self.notes))


def design_from_record(
    record: LoopRecord,
    *,
    method: str | None = None,
    gamma_ratio: float | None = None,
    sensor_gain: float | Sequence[float] | None = None,
    announced: ArrayLike = (),
    imaging: Imaging | None = None,
    accept_record: bool = False,
    command_scale_known: bool = False,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> RecordedDesign:
    """Identify a loop from its record, design a controller, and test it on unseen data.

    Before anything is fitted, the commands must explain the measurements as they are given
    (``explain_commands``). The test is honest and conservative: a model of the first half of
    the usable frames gives a design, and that is replayed on the second half. The design that is
    returned is made the same way from all frames.

    Without a method, the quick ones that need no more than a plant are tested in this way. The
    Kalman filter stays unless another one leaves less on each third of the test, by more than twice
    the error of the difference and 2 % of the measured variance. Where it does not stay, the test
    is a little kind to the chosen one.

    Parameters
    ----------
    record : LoopRecord
        What the loop recorded; the delay must be known.
    method : str, optional
        Method of synthesis that needs no more than a plant; chosen by default.
    gamma_ratio : float, optional
        For methods with a bound: the norm as a multiple of the least one; 1.2 by default.
    sensor_gain, announced
        As for :func:`identify`.
    imaging : Imaging, optional
        The camera, for Strehl ratios; 2.2 um by default.
    accept_record : bool, optional
        Go on although something else explains the record better; the design says so.
    command_scale_known : bool, optional
        The commands were recorded at the size that was applied. No record can tell this from
        half that size, so by default a design is also stable at half the sensor gain.
    progress : callable, optional
        Called with 1 after each of 3 steps.
    **options
        ``lowest_line_hz`` and ``most_lines`` of :func:`identify`.

    Returns
    -------
    RecordedDesign
        The design, the models and the test.

    Raises
    ------
    ProblemError
        If less than 4 s of the record, or 1024 frames, are usable, its delay is missing, or a
        value is out of range.
    RecordError
        If the commands do not reach the measurements as the record says.
    NumericalError, CertificateError
        If a fit fails; or if a design does not pass its checks, or none is stable at all
        sensor gains that the record allows.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=50)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.3).controller, truth, hardware=path, frames=20_000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> made = lbt.design_from_record(record)
    >>> table = made.held_out
    >>> bool(table[made.name].replayed_nm < 0.5 * table["what ran"].replayed_nm)
    True
    """
    defaults = {} if gamma_ratio is None else {"gamma_ratio": gamma_ratio}
    usable = _require_able(record, method, defaults)
    notes, assumptions = _judge_commands(record, sensor_gain, accept_record)
    step = progress or (lambda _: None)
    options |= {"sensor_gain": sensor_gain, "announced": announced}
    first, _ = split_halves(record.stretches(), record.frames)
    half = identify(record, stretches=first, **options)
    finds_gain = record.commands is not None and sensor_gain is None
    design = partial(_design, defaults=defaults)
    if finds_gain:
        assumptions += _judge_gains(half, accept_record)
    designs: dict[str, Design] = {}
    if method is None:
        tried = {name: method_named(name).reference_options for name in quick_methods()}
        designs, missing = stable_designs(half.plant(), tried, defaults)
        notes += missing
    if not designs:
        name = method or default_method()
        designs = {method_named(name).title: design(name, half)}
    step(1)
    held_out = compare_on_record(record, half, designs, imaging=imaging or Imaging())
    if method is None:
        names = {method_named(name).title: name for name in quick_methods()}
        rows = [(names[row.name], row.replayed) for row in held_out.entries if row.name in names]
        residuals = {name: residual for name, residual in rows if residual is not None}
        unsafe = []
        if finds_gain:
            path, allowed = half.hardware, allowed_gains(record, half)
            unsafe = [
                names[title]
                for title, tried_design in designs.items()
                if unstable_gains(path, tried_design.controller, allowed) is not None
            ]
        method, words = choose_method(residuals, unsafe)
        notes += words
    step(1)
    model = identify(record, start=half, **options)
    made, careful = design_for_gains(
        model,
        partial(design, method),
        _design_robustly,
        allowed_gains(record, model) if finds_gain else None,
        command_scale_known=command_scale_known,
    )
    step(1)
    return RecordedDesign(
        model=model,
        design=replace(made, assumptions=(*assumptions, *made.assumptions)),
        half_model=half,
        held_out=held_out,
        name=method_named(method).title,
        notes=(
            *notes,
            *careful,
            *_compare_gains(model, half),
            *note_drift(record, model.plant(), made.controller),
            *_note_short(usable, model),
        ),
    )


def _design(method: str, model: IdentifiedModel, *, defaults: Mapping[str, Any]) -> Design:
    inputs = PlantInputs(plant=model.plant(), design_defaults=defaults)
    return design_request(method, {}).build(inputs)


def _require_able(record: LoopRecord, method: str | None, defaults: Mapping[str, Any]) -> float:
    """Return the usable seconds of a record; refuse it, or a method and options that cannot be."""
    require_instance(record, LoopRecord)
    if method is not None:
        choice(method, "method", record_methods())
    if defaults:  # refuses what the method does not take
        design_request(method or option_owners("gamma_ratio")[0], defaults)
    _ = record.hardware  # refuses a record without a delay
    return require_length(record, seconds=LEAST_SECONDS) / record.frame_rate_hz


def _design_robustly(model: IdentifiedModel, gains: tuple[float, float]) -> Design:
    """Design for an interval of gains, relative to the model's, by a method that can."""
    inputs = PlantInputs(plant=model.plant(), sensor_gains=gains)
    return design_request(gain_robust_method(), {}).build(inputs)


def _note_short(seconds: float, model: IdentifiedModel) -> Iterator[str]:
    """Yield what a short record leaves open."""
    if seconds < _SHORT_SECONDS:
        resolution_hz = max(axis.resolution_hz for axis in model.axes)
        yield (
            f"the record is short ({seconds:.3g} s): it does not tell lines less than "
            f"{resolution_hz:.2g} Hz apart from one. Half a minute shows more"
        )


def _judge_commands(
    record: LoopRecord, sensor_gain: float | Sequence[float] | None, accept: bool
) -> tuple[list[str], list[str]]:
    """Return notes on the commands and what is assumed of them; refuse a record that is wrong."""
    if record.commands is None:
        return [], ["the sensor gain is 1: a record of an open loop does not show it"]
    verdict = explain_commands(record, sensor_gain=sensor_gain)
    if not accept:
        verdict.require_accepted()
    given = []
    if sensor_gain is not None:
        gains = " and ".join(f"{gain:g}" for gain in np.ravel(sensor_gain))
        given = [f"the sensor gain is {gains}, as it was given"]
    return list(verdict.notes), [*verdict.overruled, *given]


def _judge_gains(model: IdentifiedModel, accept: bool) -> tuple[str, ...]:
    """Return what is assumed of fitted gains; refuse those of commands in another unit."""
    errors = np.array([axis.sensor_gain_error or np.inf for axis in model.axes])
    verdict = judge_fitted_gains(np.array(model.sensor_gains), errors)
    if not accept:
        verdict.require_accepted()
    return verdict.overruled


def _compare_gains(model: IdentifiedModel, half: IdentifiedModel) -> Iterator[str]:
    """Warn of sensor gains that disagree."""
    for i, (whole, first) in enumerate(zip(model.axes, half.axes, strict=True)):
        if whole.sensor_gain_error is None or first.sensor_gain_error is None:
            continue
        apart = abs(whole.sensor_gain - first.sensor_gain)
        if apart > DIFFERENT * float(np.hypot(whole.sensor_gain_error, first.sensor_gain_error)):
            yield (
                f"warning: axis {i} has a sensor gain of {first.sensor_gain:.3f} in the first half "
                f"of the record, and of {whole.sensor_gain:.3f} in all of it"
            )


def note_drift(record: LoopRecord, plant: TipTiltPlant, controller: Controller) -> Iterator[str]:
    """Yield a note on each axis whose offset and drift leave much beside its residual.

    The fit sees a drift in its lowest frequencies only, and an offset not at all. The filter sees
    both, and what it does not reject at zero frequency stays in the residual for ever.
    """
    loop = close_loop(plant.hardware, controller)
    budget = residual_budget(loop, plant, frame_means=True)
    residual_nm = np.sqrt(np.diag(budget.total_nm2))
    series = record.pseudo_open_loop(np.diag(loop.hardware.sensor))[record.usable]
    seconds = np.flatnonzero(record.usable) / record.frame_rate_hz
    speed, mean = np.polyfit(seconds - np.mean(seconds), series, 1)
    away = np.abs(mean) + np.abs(speed) * np.ptp(seconds) / 2
    rejected = loop.rejection().frequency_response([0.0])[0].real
    for i, rest_nm in enumerate(np.abs(rejected) @ away):
        if rest_nm > _DRIFT_SHARE * residual_nm[i]:
            yield (
                f"axis {i} of the record stands {nm_text(mean[i])} off zero and drifts by "
                f"{nm_text(speed[i])}/s. The filter sees that, and leaves up to "
                f"{nm_text(rest_nm, '.2g')} of it. Offload it to the telescope"
            )


def quick_methods() -> list[str]:
    """Return the names of the methods that an automatic choice tries, the default first."""
    names = [name for name in record_methods() if not method_named(name).slow]
    return sorted(names, key=lambda name: name != default_method())


def choose_method(
    residuals: Mapping[str, ResidualEstimate], unsafe: Collection[str] = ()
) -> tuple[str, list[str]]:
    """Choose the default method, unless another one leaves clearly less on every third of a test.

    The loops of ``unsafe`` designs are unstable at a sensor gain that the record allows. Return the
    name of the method, and by how much it is better.
    """
    usual, notes = default_method(), list[str]()
    ordered = sorted(residuals, key=lambda name: residuals[name].total_nm2)
    if usual not in residuals:
        title = method_named(ordered[0]).title
        return ordered[0], [f"the {title} is chosen: of the methods that are left it leaves least"]
    for name in ordered:
        if not _is_better(residuals[name], residuals[usual]):
            continue
        title = method_named(name).title
        if name not in unsafe:
            difference, error = residuals[usual].above(residuals[name])
            gained = nm_text(difference, error_nm=error, unit="nm^2")
            words = (
                f"the {title} is chosen: on each of {_PARTS} parts of the test it leaves less than "
                f"the {method_named(usual).title}, in all by {gained}"
            )
            return name, [words, *notes]
        notes.append(
            f"the {title} is left out: its loop is unstable at a sensor gain that the record allows"
        )
    words = (
        f"the {method_named(usual).title} stays: no method tried leaves less on each of {_PARTS} "
        f"parts of the test, by more than {_ERRORS:g} standard errors and "
        f"{100 * _LEAST_SHARE:g} % of the variance"
    )
    return usual, [words, *notes]


def _is_better(residual: ResidualEstimate, usual: ResidualEstimate) -> bool:
    """Whether a residual is clearly less than the usual one on every part of the test."""
    for part, reference in zip(residual.parts(_PARTS), usual.parts(_PARTS), strict=True):
        difference, error = reference.above(part)
        if difference <= max(_ERRORS * error, _LEAST_SHARE * reference.measured_nm2):
            return False
    return True
