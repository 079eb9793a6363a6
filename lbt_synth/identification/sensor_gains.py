"""The sensor gains that a record allows, and a design that is stable at all of them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import product

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, ProblemError, SynthesisError
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.commands.verdict import could_have_run, record_law
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS, POSSIBLE_GAINS
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedModel
from lbt_synth.identification.fit.identify import OPEN_GAIN
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop, residual_budget, stable_sensor_gains
from lbt_synth.models import LoopHardware
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import FloatArray

_STEPS = 33  # gains between the possible ones at which the law that ran is tried
_MISFIT = 1.5  # factor by which a gain may be off where the model leaves something out
_STEP = 0.05  # of the logarithm of a gain that a design may assume in place of the fitted one
_HALF = 0.5  # of the gains are left of commands recorded at half their size
_UNEVEN = 1.3  # ratio of the gains of two axes that one sensor hardly has
_WORTH_ASKING = 1.05  # ratio of residuals from which knowing the gain is worth a question


def allowed_gains(record: LoopRecord, model: IdentifiedModel) -> FloatArray:
    """Return the interval of sensor gains of each axis that a closed-loop record allows.

    Parameters
    ----------
    record : LoopRecord
        A closed-loop record with its delay.
    model : IdentifiedModel
        Its model.

    Returns
    -------
    (axes, 2) ndarray
        Least and largest gain within three standard errors of the model's, and a factor of 1.5
        where its innovations are not white. Of these, only gains at which the law that ran was
        stable, and from 0.2 to 1.25, as sensors have them, if the model's is among these.

    Raises
    ------
    ProblemError
        If the record has no delay.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0, sensor_gain=0.6)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.4).controller, truth, hardware=path, frames=10_000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> low, high = lbt.identification.allowed_gains(record, lbt.identify(record))[0]
    >>> bool(low < 0.6 < high < 1)
    True
    """
    running = _running_gains(record)
    rows = []
    for axis in model.axes:
        gain, error = axis.sensor_gain, axis.sensor_gain_error or 0.0
        factor = np.exp(DIFFERENT * error / gain) * (1.0 if axis.whiteness.white else _MISFIT)
        limits = [running]
        if PLAUSIBLE_GAINS[0] <= gain <= PLAUSIBLE_GAINS[1]:
            limits.append(PLAUSIBLE_GAINS)
        low, high = gain / factor, gain * factor
        for least, most in limits:
            low, high = min(max(low, least), most), max(min(high, most), least)
        rows.append((low, high))
    return np.array(rows)


def _running_gains(record: LoopRecord) -> tuple[float, float]:
    """Return the ends of the possible gains beyond which the law that ran was unstable."""
    law = record_law(record)
    if law is None or law.kind == "none" or law.lag_frames < 0:
        return POSSIBLE_GAINS
    gains = np.geomspace(*POSSIBLE_GAINS, _STEPS)
    running = np.flatnonzero(
        [could_have_run(CommandRepair(), [gain], record, law) for gain in gains]
    )
    if not running.size:
        return POSSIBLE_GAINS
    beyond = max(running[0] - 1, 0), min(running[-1] + 1, _STEPS - 1)
    return float(gains[beyond[0]]), float(gains[beyond[1]])


def unstable_gains(
    hardware: LoopHardware, controller: Controller, gains: FloatArray
) -> FloatArray | None:
    """Return sensor gains within intervals (axes, 2) at which a loop is unstable.

    Each corner of the box is tried, and all common factors on the gains of the hardware that its
    sides allow: exact for axes that decouple. None if the loop is stable at all of them.
    """
    for corner in product(*gains):
        path = replace(hardware, sensor_matrix=np.diag(corner))
        if not close_loop(path, controller).is_stable:
            return np.array(corner)
    assumed = np.diag(hardware.sensor)
    factors = gains / assumed[:, None]
    low, high = stable_sensor_gains(hardware, controller)
    for factor in (np.min(factors), np.max(factors)):
        if not low < factor < high:
            return np.asarray(factor * assumed)
    return None


def design_for_gains(
    model: IdentifiedModel,
    design: Callable[[IdentifiedModel], Design],
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    allowed: FloatArray | None,
    *,
    command_scale_known: bool,
) -> tuple[Design, tuple[str, ...]]:
    """Return a design that is stable at all sensor gains that a record allows, and notes.

    Its first assumption says which gains these are. Commands that were recorded at half their size
    look like twice the sensor gain, and no record can tell; so half of the gains are possible,
    unless the scale of the commands is known. Where the axes have different gains, the commands of
    either may have another size than was recorded, and each axis may have the gains of both. Where
    the design for the fitted gain is unstable at one of them, the best of the designs that assume
    another gain takes its place, or a robust one.
    """
    usual = design(model)
    if allowed is None:
        return usual, ()
    intervals = allowed
    assumed = (
        f"the sensor gain lies within {_in_words(allowed)}, as the record and its model allow; "
        "the loop is stable at all of these"
    )
    if command_scale_known:
        assumed += ". The commands were recorded at the size that was applied, as was stated"
    else:
        intervals = allowed * [_HALF, 1.0]
        assumed += " and at half of them, should the commands be recorded at half their size"
        if max(model.sensor_gains) > _UNEVEN * min(model.sensor_gains):
            low = np.minimum(intervals[:, 0], allowed.min())
            intervals = np.column_stack([low, np.full(len(low), allowed.max())])
            assumed += ", and each axis at those of both, because they differ"
    bad = unstable_gains(model.hardware, usual.controller, intervals)
    if bad is None:
        return replace(usual, assumptions=(assumed, *usual.assumptions)), ()
    safe = _assume_another(model, design, intervals)
    if safe is None:
        safe = _robust(model, bad, intervals, design_robustly, command_scale_known)
    note = _price(model, usual, safe, allowed, intervals, command_scale_known)
    return replace(safe, assumptions=(assumed, *safe.assumptions)), (note,)


def _assume_another(
    model: IdentifiedModel, design: Callable[[IdentifiedModel], Design], intervals: FloatArray
) -> Design | None:
    """Return the better of the designs for the nearest gains, below and above, stable at all."""
    fitted, stable = float(np.exp(np.mean(np.log(model.sensor_gains)))), []
    for end in (float(np.min(intervals)), float(np.max(intervals))):
        count = int(np.ceil(abs(np.log(end / fitted)) / _STEP))
        for gain in np.geomspace(fitted, end, count + 1)[1:].tolist():
            with suppress(CertificateError, SynthesisError):
                careful = design(_with_gain(model, gain))
                if unstable_gains(model.hardware, careful.controller, intervals) is None:
                    stable.append(careful)
                    break
    return min(stable, key=lambda one: _residual_nm(one, model), default=None)


def _with_gain(model: IdentifiedModel, gain: float) -> IdentifiedModel:
    """Return a model whose sensor has another gain on all axes, beside the same disturbance."""
    axes = tuple(replace(axis, sensor_gain=gain) for axis in model.axes)
    return replace(model, axes=axes)


def _residual_nm(design: Design, model: IdentifiedModel) -> float:
    """Return what a design leaves in a model; infinite where its loop is unstable."""
    loop = close_loop(model.hardware, design.controller)
    return residual_budget(loop, model.truth()).rms_nm if loop.is_stable else float("inf")


def _price(
    model: IdentifiedModel,
    usual: Design,
    safe: Design,
    allowed: FloatArray,
    intervals: FloatArray,
    command_scale_known: bool,
) -> str:
    """Say what stability at all gains costs, and ask for what would buy it back."""
    paid, least = _residual_nm(safe, model), _residual_nm(usual, model)
    note = (
        f"to be stable at sensor gains of {_in_words(intervals)}, the design leaves "
        f"{nm_text(paid)} in the model; without that it would leave {nm_text(least)}"
    )
    wanted = list[str]()
    if (
        not command_scale_known
        and unstable_gains(model.hardware, usual.controller, allowed) is None
    ):
        wanted.append("--command-scale 1 if the commands were recorded at the size applied")
    if any((axis.sensor_gain_error or 0.0) > OPEN_GAIN * axis.sensor_gain for axis in model.axes):
        wanted.append("--sensor-gain, which the record leaves open")
    if wanted and paid > _WORTH_ASKING * least:
        return f"warning: {note}. Give {' or '.join(wanted)}"
    return note


def _robust(
    model: IdentifiedModel,
    bad: FloatArray,
    intervals: FloatArray,
    design_robustly: Callable[[IdentifiedModel, tuple[float, float]], Design],
    command_scale_known: bool,
) -> Design:
    """Return a design by robust synthesis, or refuse with the gains that are bad for another."""
    factors = intervals / np.array(model.sensor_gains)[:, None]
    with suppress(SynthesisError, ProblemError):  # a plant without lines has no such design
        design = design_robustly(model, (float(np.min(factors)), float(np.max(factors))))
        if unstable_gains(model.hardware, design.controller, intervals) is None:
            return design
    gain = ", ".join(f"{value:.3g}" for value in bad)
    advice = "" if command_scale_known else ", or say --command-scale 1 (recorded as applied)"
    raise CertificateError(
        f"the loop of the design is unstable at the sensor gain {gain}, and the record allows "
        f"{_in_words(intervals)}. Record with a higher loop gain, look for jumps in the record, "
        f"give the sensor gain{advice}."
    )


def _in_words(intervals: FloatArray) -> str:
    return " and ".join(dict.fromkeys(f"{low:.3g} to {high:.3g}" for low, high in intervals))
