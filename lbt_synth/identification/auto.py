"""A certified controller from a record, tested on data that it has not seen.

The Kalman filter is the default. It stays unless another method leaves clearly less on every third
of the test: one that wins on some parts only has won by what changed between them. A design is
stable at all sensor gains that the record allows.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import CertificateError, NumericalError, SynthesisError
from lbt_synth.identification.accelerometers.readings import channels_beside
from lbt_synth.identification.commands.control_law import fit_control_law
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.commands.verdict import (
    could_have_run,
    explain_commands,
    judge_fitted_gains,
)
from lbt_synth.identification.fit.fitting import GAIN_STEP, PLAUSIBLE_GAINS, POSSIBLE_GAINS
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedModel
from lbt_synth.identification.fit.identify import OPEN_GAIN, identify
from lbt_synth.identification.prediction.comparison import (
    WITHOUT,
    PredictionRow,
    PredictionTable,
    compare_designs,
    design_inputs,
)
from lbt_synth.identification.prediction.regression import ChannelValue, channel_values, regress
from lbt_synth.identification.prediction.residual import ResidualEstimate
from lbt_synth.identification.records.record import LEAST_SECONDS as LEAST_RECORD_SECONDS
from lbt_synth.identification.records.record import (
    LoopRecord,
    keep_frames,
    require_length,
    split_halves,
)
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, stable_sensor_gains
from lbt_synth.loop.budget import model_covariances
from lbt_synth.methods.registry import default_method, method_named, record_methods
from lbt_synth.methods.request import design_request
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import BoolArray, FloatArray, choice, require_instance

_DRIFT_SHARE = 0.3  # of the residual, that an offset may leave without a note
LEAST_SECONDS = 2 * LEAST_RECORD_SECONDS  # usable: half of it has to show a model
GAINS_LIE = "the sensor gain lies within"  # begins what a design assumes of it
DELAY_ERROR = 0.1  # frames, by which every design of a record may be off
_MOST_NOISE = 10  # octaves of noise, by which a filter trusts its sensor no more
_MISFIT = 1.5  # factor by which a gain may be off where the model leaves something out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedDesign(Summarised):
    """A controller designed from a record."""

    model: IdentifiedModel  # from all usable frames
    design: Design  # certified for this model
    half_model: IdentifiedModel  # from the first half of the usable frames
    # residuals on the second half: what ran, a design from the first half, references
    held_out: PredictionTable
    name: str  # row of the design in held_out, the title of its method
    gains: FloatArray  # (axes, 2): ends of the sensor gains that the record allows
    channels: tuple[ChannelValue, ...] = ()  # what each accelerometer is worth, if they are read
    notes: tuple[str, ...]  # warnings about the design

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
    sensor_gain: float | Sequence[float] | None = None,
    imaging: Imaging | None = None,
    accept_record: bool = False,
    command_scale_known: bool = False,
    separate_axes: bool = False,
    accelerations: ArrayLike | None = None,
    channels: Sequence[str] | None = None,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> RecordedDesign:
    """Identify a loop from its record, design a controller, and test it on unseen data.

    Before anything is fitted, the commands must explain the measurements as they are given. The
    test is honest and conservative: designs for a model of the first half of the usable frames are
    replayed on the second half. The design that is returned is made the same way from all frames.

    Without a method, the quick ones that need no more than a plant are tested. The Kalman filter
    stays unless another one leaves less on each third of the test, by more than 2 % of the measured
    variance and than twice the error of the difference, or by 25 % of the rms.

    Parameters
    ----------
    record : LoopRecord
        What the loop recorded; the delay must be known.
    method : str, optional
        Method of synthesis that needs no more than a plant; chosen by default.
    sensor_gain : float or one per axis, optional
        As for :func:`identify`.
    imaging : Imaging, optional
        The camera, for Strehl ratios; 2.2 um by default.
    accept_record : bool, optional
        Go on although something else explains the record better; the design says so.
    command_scale_known : bool, optional
        The commands were recorded at the size that was applied. No record can tell; by default a
        design is also stable at half the sensor gain.
    separate_axes : bool, optional
        No axis reads the measurements of the other, for targets with one filter per mode: a line
        that both share is one line of each. The test has a row of the same method without that.
    accelerations : (frames, channels) array_like, optional
        Readings of accelerometers [m/s^2], a row per frame of the record: what the computer has
        when it has the measurement of that row. NaN where one is missing. A predictor reads them.
    channels : sequence of str, optional
        Names of the channels; channel1, channel2, ... by default.
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
    beside = None
    if accelerations is not None:
        require_instance(record, LoopRecord)
        beside = channels_beside(record, accelerations, channels)
        record = keep_frames(record, beside.good)
    _require_able(record, method)
    notes, assumptions = _judge_commands(record, sensor_gain, accept_record)
    step, options = progress or (lambda _: None), options | {"sensor_gain": sensor_gain}
    mixed = identify(split_halves(record)[0], **options)
    half = mixed.separated() if separate_axes else mixed
    if finds_gain := record.commands is not None and sensor_gain is None:
        assumptions += _judge_gains(half, accept_record, record.read_with)
    step(1)
    names = quick_methods() if method is None else [method]
    requests = {name: {} if method else method_named(name).reference_options for name in names}
    inputs: dict[str, Any] = {"channels": beside, "separate": separate_axes}
    imaging = imaging or Imaging()
    held_out, designs = compare_designs(record, half, requests, imaging=imaging, **inputs)
    if not designs:
        raise NumericalError(f"no design holds the loop: {'; '.join(held_out.notes)}.")
    if method is None:
        method, note = _choose(held_out, designs, names)
        notes.append(note)
    title, alone = method_named(method).title, {method: requests[method]}
    if separate_axes:
        table, _ = compare_designs(record, mixed, alone, imaging=imaging, channels=beside)
        held_out, note = _add_mixed(held_out, table.row(title), title)
        notes.append(note)
    step(1)
    model, request = identify(record, start=mixed, **options), design_request(method, {})
    model = model.separated() if separate_axes else model
    if request.method.of_record:  # one penalty, that of the noise as it is, for all trials
        inputs["penalty"] = regress(record, model, **inputs).penalty
    made_of = partial(design_inputs, record, model, **inputs)
    allowed = allowed_gains(record, model) if finds_gain else None
    design_of = lambda added_nm: request.build(made_of(added_nm=added_nm))  # noqa: E731
    made, added_nm, price = design_for_gains(
        model, design_of, allowed, command_scale_known=command_scale_known
    )
    known, tested = np.repeat(np.array(model.sensor_gains)[:, None], 2, axis=1), held_out
    if added_nm.any():
        tested, designs = compare_designs(record, half, alone, added_nm=added_nm, **inputs)
        notes.append(_say_price(price, tested.row(title), held_out.row(title)))
    if of_record := request.method.of_record:
        made = _with_claims(made, designs.get(title, made), tested, title)
    step(1)
    return RecordedDesign(
        model=model,
        design=replace(made, assumptions=(*assumptions, *made.assumptions)),
        half_model=half,
        held_out=held_out,
        name=title,
        gains=known if allowed is None else allowed,
        channels=channel_values(record, half, beside) if of_record and beside else (),
        notes=(
            *notes,
            *_compare_gains(model, half),
            *note_drift(record, model.plant(), made.close(model.hardware)),
        ),
    )


def _choose(
    table: PredictionTable, designs: Mapping[str, Design], names: Sequence[str]
) -> tuple[str, str]:
    """Choose a method among those whose design was tested; return why, too."""
    rows = {row.name: row.replayed for row in table.entries if row.name in designs}
    title, note = choose_method({name: data for name, data in rows.items() if data})
    return next(name for name in names if method_named(name).title == title), note


def _add_mixed(
    table: PredictionTable, row: PredictionRow | None, title: str
) -> tuple[PredictionTable, str]:
    """Return a table with the row of a method whose axes mix, and what it leaves in words."""
    mixes = row.replayed.text if row and row.replayed else "an unknown residual"
    if row:
        mixed = replace(row, name=f"{title}, axes mixed")
        table = replace(table, entries=(*table.entries, mixed))
    return table, f"with axes that mix, the {title} leaves {mixes} on unseen data"


def _with_claims(made: Design, past: Design, table: PredictionTable, title: str) -> Design:
    """Return a predictor with what that of the first half, in a table, lets it claim."""
    saved = past.claims["fit_share"] - made.claims["fit_share"]
    return replace(made, claims={**made.claims, **_claims(table, title, saved)})


def _say_price(price: str, now: PredictionRow | None, before: PredictionRow | None) -> str:
    """Say what a design that assumes more noise leaves on unseen data, and without that."""
    unknown = "an unknown residual"
    leaves = [row.replayed.text if row and row.replayed else unknown for row in (now, before)]
    return f"{price}. It leaves {leaves[0]} on unseen data, and without that {leaves[1]}"


def _claims(table: PredictionTable, title: str, saved: float) -> dict[str, float]:
    """Return what a predictor claims: what that of the first half leaves, where it is above 0."""
    claims, alone = dict[str, float](), table.row(f"{title}{WITHOUT}")
    if (row := table.row(title)) and row.replayed:  # a fit of all frames has smaller errors
        left_nm2 = row.replayed.total_nm2 - saved * row.replayed.measured_nm2
        error_nm2 = row.replayed.total_error_nm2
        if left_nm2 > 0:
            left_nm = float(np.sqrt(left_nm2))
            claims = {"residual_nm": left_nm, "residual_error_nm": error_nm2 / (2 * left_nm)}
    if alone and alone.replayed_nm > 0:
        claims["alone_nm"] = alone.replayed_nm
    return claims


def _require_able(record: LoopRecord, method: str | None) -> None:
    """Refuse a record that is too short, or a method that needs more than a plant."""
    require_instance(record, LoopRecord)
    if method is not None:
        choice(method, "method", record_methods())
    _ = record.hardware  # refuses a record without a delay
    require_length(record, seconds=LEAST_SECONDS)


def _judge_commands(
    record: LoopRecord, sensor_gain: float | Sequence[float] | None, accept: bool
) -> tuple[list[str], list[str]]:
    """Return notes on the commands and what is assumed of them; refuse a record that is wrong."""
    if record.commands is None:
        return [], ["the sensor gain is 1: a record of an open loop does not show it"]
    verdict = explain_commands(record, sensor_gain=sensor_gain)
    if not accept:
        verdict.require_accepted()
    assumptions = list(verdict.overruled)
    if sensor_gain is not None:
        gains = " and ".join(f"{gain:g}" for gain in np.ravel(sensor_gain))
        assumptions.append(f"the sensor gain is {gains}, as it was given")
    return list(verdict.notes), assumptions


def _judge_gains(model: IdentifiedModel, accept: bool, read_with: str) -> tuple[str, ...]:
    """Return what is assumed of fitted gains; refuse those of commands in another unit."""
    errors = np.array([axis.sensor_gain_error or np.inf for axis in model.axes])
    verdict = judge_fitted_gains(np.array(model.sensor_gains), errors)
    verdict = replace(verdict, read_with=read_with)
    if not accept:
        verdict.require_accepted()
    return verdict.overruled


def _compare_gains(model: IdentifiedModel, half: IdentifiedModel) -> Iterator[str]:
    """Warn of sensor gains that changed after the first half of a record."""
    for i, (axis, first) in enumerate(zip(model.axes, half.axes, strict=True)):
        error = np.hypot(axis.sensor_gain_error or np.inf, first.sensor_gain_error or np.inf)
        if abs(axis.sensor_gain - first.sensor_gain) > DIFFERENT * error:
            yield (
                f"warning: axis {i} has a sensor gain of {first.sensor_gain:.3f} in the first half "
                f"of the record, and of {axis.sensor_gain:.3f} in all of it"
            )


def note_drift(record: LoopRecord, plant: TipTiltPlant, loop: ClosedLoop) -> Iterator[str]:
    """Yield a note on each axis whose offset and drift leave much beside its residual.

    The fit sees a drift in its lowest frequencies only, and an offset not at all. The filter sees
    both, and what it does not reject at zero frequency stays in the residual for ever.
    """
    if loop.reads_others:
        return
    covariance = model_covariances(loop, plant).mean(axis=0)
    residual_nm = np.sqrt(np.diag(covariance)[: record.axes])
    series = record.pseudo_open_loop(np.diag(loop.hardware.sensor))[record.usable]
    seconds = np.flatnonzero(record.usable) / record.frame_rate_hz
    speed, mean = np.polyfit(seconds - np.mean(seconds), series, 1)
    away = np.abs(mean) + np.abs(speed) * np.ptp(seconds) / 2
    rejected = loop.path("phase", "residual").frequency_response([0.0])[0].real
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


def choose_method(residuals: Mapping[str, ResidualEstimate]) -> tuple[str, str]:
    """Choose the default method, unless another one leaves clearly less on every third of a test.

    The residuals are by the titles of methods; return one of these, and why it is chosen. One that
    the noise hides counts as its bound.
    """
    ordered = sorted(residuals, key=lambda title: residuals[title].safe_nm2)
    usual = method_named(default_method()).title
    usual = usual if usual in residuals else ordered[0]
    for title in ordered:
        thirds = zip(residuals[usual].parts(3), residuals[title].parts(3), strict=True)
        if residuals[title].safe_nm2 < residuals[usual].total_nm2 and all(
            third.is_clearly_above(rival) for third, rival in thirds
        ):
            difference, error = residuals[usual].above(residuals[title])
            return title, (
                f"the {title} is chosen: on each third of the test it leaves less than the "
                f"{usual}, in all by {nm_text(difference, error_nm=error, unit='nm^2')}"
            )
    note = f"the {usual} stays: no method leaves clearly less on each third of the test"
    is_hidden = any(residual.hidden for residual in residuals.values())
    return usual, note + ", as far as the noise shows" * is_hidden


def allowed_gains(record: LoopRecord, model: IdentifiedModel) -> FloatArray:
    """Return the interval of sensor gains of each axis that a closed-loop record allows, (axes, 2).

    Within three standard errors of the model's, and a factor of 1.5 where its innovations are not
    white. Of these, only gains at which the law that ran was stable, and from 0.2 to 1.25, as
    sensors have them, if the model's is among these.
    """
    running = _running_gains(record)
    rows = []
    for axis in model.axes:
        gain, error = axis.sensor_gain, axis.sensor_gain_error or 0.0
        factor = np.exp(DIFFERENT * error / gain) * (1.0 if axis.whiteness.white else _MISFIT)
        is_plausible = PLAUSIBLE_GAINS[0] <= gain <= PLAUSIBLE_GAINS[1]
        ends = np.array([gain / factor, gain * factor])
        for limits in (running, PLAUSIBLE_GAINS if is_plausible else POSSIBLE_GAINS):
            ends = np.clip(ends, *limits)
        rows.append(ends)
    return np.array(rows)


def _running_gains(record: LoopRecord) -> tuple[float, float]:
    """Return the ends of the possible gains beyond which the law that ran was unstable."""
    law = fit_control_law(record)
    if law is None or law.kind == "none" or law.lag_frames < 0:
        return POSSIBLE_GAINS
    least, most = POSSIBLE_GAINS
    gains = np.geomspace(least, most, int(np.ceil(np.log(most / least) / GAIN_STEP)) + 1)
    ran = [could_have_run(CommandRepair(), [gain], record, law) for gain in gains]
    if not any(ran):
        return POSSIBLE_GAINS
    beside = np.convolve(ran, [1, 1, 1], "same") > 0  # the limit is between two gains
    return float(gains[beside][0]), float(gains[beside][-1])


def unstable_gains(design: Design, gains: FloatArray) -> FloatArray | None:
    """Return sensor gains within intervals (axes, 2) at which a loop of a design is unstable.

    Each corner of the box is tried, and all common factors on the gains of the design that its
    sides allow: exact for axes that decouple; both with the delay of the design, and at a tenth of
    a frame from it, of the design and its fall-backs. None if all are stable at all of them.
    """
    hardware = require_hardware(design, "an interval of gains")
    delay, factors = hardware.delay_frames, gains / np.diag(hardware.sensor)[:, None]
    for controller in design.controllers.values():
        loop = close_loop(hardware, controller).feedback()
        for late in (0.0, DELAY_ERROR, -min(DELAY_ERROR, delay - 1)):
            path = replace(loop.hardware, delay_frames=delay + late)
            for corner in product(*map(np.unique, gains)):
                turned = replace(path, sensor_matrix=np.diag(corner))
                if not close_loop(turned, loop.controller).is_stable:
                    return np.array(corner)
            ends = (np.min(factors), np.max(factors))
            if ends == (1.0, 1.0):  # the only corner
                continue
            low, high = stable_sensor_gains(path, loop.controller)
            for factor in ends:
                if not low < factor < high:
                    return np.asarray(factor * np.diag(hardware.sensor))
    return None


def design_for_gains(
    model: IdentifiedModel,
    design: Callable[[FloatArray], Design],
    allowed: FloatArray | None,
    *,
    command_scale_known: bool,
) -> tuple[Design, FloatArray, str]:
    """Return a design that is stable at all sensor gains that a record allows, and its noise.

    ``design`` makes one that assumes more noise than the model, as phase of each axis [nm], which
    is returned with it. Commands that were recorded at half their size look like twice the sensor
    gain; so unless their scale is known, half of the gains are possible, and each axis may have
    those of both. Where the design is unstable at one of them, or with a delay a tenth of a frame
    off, the one of least more noise that is stable takes its place, and a note says so.
    """
    none_nm, assumed = np.zeros(len(model.axes)), list[str]()
    usual = design(none_nm)
    intervals = np.repeat(np.array(model.sensor_gains)[:, None], 2, axis=1)
    if allowed is not None:
        intervals = allowed
        sentence = (
            f"{GAINS_LIE} {_in_words(allowed)}, as the record and its model allow; "
            "the loop is stable at all of these"
        )
        if command_scale_known:
            sentence += ". The commands were recorded at the size that was applied, as was stated"
        else:
            intervals = np.tile([allowed.min() / 2, allowed.max()], (len(allowed), 1))
            sentence += " and at half of them, should the commands be recorded at half their size"
            if np.ptp(allowed, axis=0).any():
                sentence += ", and each axis at those of both, because they differ"
        assumed.append(sentence)
    bad = unstable_gains(usual, intervals)
    if bad is None:
        return replace(usual, assumptions=(*assumed, *usual.assumptions)), none_nm, ""
    wanted = list[str]()
    if allowed is not None and not command_scale_known:
        wanted.append("--command-scale 1 if the commands were recorded at the size applied")
    if allowed is not None and np.any(allowed[:, 1] > (1 + DIFFERENT * OPEN_GAIN) * allowed[:, 0]):
        wanted.append("--sensor-gain, which the record leaves open")
    advice = f". Give {' or '.join(wanted)}" if wanted else ""
    stable = _assume_noise(model, design, intervals, np.ones(len(model.axes), np.bool_))
    if stable is None:
        gain = ", ".join(f"{value:.3g}" for value in bad)
        raise CertificateError(
            f"the loop of the design is unstable at the sensor gain {gain}, or there with a delay "
            f"{DELAY_ERROR:g} frames off, and the record allows {_in_words(intervals)}. Record "
            f"with a higher loop gain, or look for jumps in it{advice}."
        )
    safe, added_nm = stable
    axes = " and ".join(f"axis {i}" for i in np.flatnonzero(added_nm))
    where = "each axis" if added_nm.all() else axes
    note = (
        f"{'warning: ' * bool(wanted)}to be stable at sensor gains of {_in_words(intervals)}, and "
        f"with a delay up to {DELAY_ERROR:g} frames off, the design assumes "
        f"{nm_text(added_nm.max(), '.3g')} more noise on {where}{advice}"
    )
    return replace(safe, assumptions=(*assumed, *safe.assumptions)), added_nm, note


def _assume_noise(
    model: IdentifiedModel,
    design: Callable[[FloatArray], Design],
    intervals: FloatArray,
    noisy: BoolArray,
) -> tuple[Design, FloatArray] | None:
    """Return the design of least more noise that is stable at all gains, and that noise (n,) [nm].

    It is the same on each of the noisy axes (n,), because what an axis sees of a shared line steers
    the others, and none on axes that are stable without.
    """
    designs = dict[int, Design]()
    noises_nm = np.array([axis.noise_nm / axis.sensor_gain for axis in model.axes])

    def added_nm(step: int) -> FloatArray:
        """Return what raises the rms over the noisy axes by so many eighths of an octave."""
        level_nm = np.sqrt((4.0 ** (step / 8) - 1) * np.mean(noises_nm[noisy] ** 2))
        return np.where(noisy, level_nm, 0.0)

    def is_stable(step: int) -> bool:
        """Whether there is a design that assumes so much, and it is stable."""
        with suppress(SynthesisError):
            designs[step] = design(added_nm(step))
            return unstable_gains(designs[step], intervals) is None
        return False

    # octave by octave, because a loop may be unstable again at more noise
    last = next((step for step in range(8, 8 * _MOST_NOISE + 1, 8) if is_stable(step)), None)
    if last is None:
        return None
    least = bisect_left(range(last), True, lo=last - 7, key=is_stable)
    for axis in sorted(np.flatnonzero(noisy).tolist(), key=noises_nm.__getitem__):
        others = noisy & (np.arange(noisy.size) != axis)
        less_nm = np.where(others, added_nm(least), 0.0)
        with suppress(SynthesisError):
            if others.any() and unstable_gains(calmer := design(less_nm), intervals) is None:
                return _assume_noise(model, design, intervals, others) or (calmer, less_nm)
    return designs[least], added_nm(least)


def _in_words(intervals: FloatArray) -> str:
    """Return intervals of gains as text, equal ones once."""
    return " and ".join(dict.fromkeys(f"{low:.3g} to {high:.3g}" for low, high in intervals))
