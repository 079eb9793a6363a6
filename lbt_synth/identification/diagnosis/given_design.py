"""A design of a gain file, in the loop of a record: stability, residual, agreement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.comparison import PredictionRow
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.loop.margins import stable_sensor_gains
from lbt_synth.methods.registry import design_title
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.storage.rows import column, table_row

_SAME_RATE = 1e-3
_SIGMAS = 3.0
_AGREES = 0.1  # of the residual that its own model promises


@table_row
class GivenDesignRow:
    """A given design on the record."""

    design: str = column("design", help="Its name")
    method: str = column("method", help="Method of synthesis")
    stable: bool = column("stable", help="Whether its loop is stable at the identified gain")
    spectral_radius: float = column("spectral radius", format=".5f", help="1 and more is unstable")
    stable_gains: str = column("stable sensor gains", help="Real sensor gains that are stable")
    sensor_gain: str = column("identified sensor gain", help="That of the record")
    replayed_nm: float = column(
        "residual on the record", unit="nm", format=".2f", help="On frames of no fit"
    )
    replayed_error_nm: float = column("+-", unit="nm", format=".2f", help="Its standard error")
    own_model_nm: float = column(
        "promised by its own model", unit="nm", format=".2f", help="For which it was designed"
    )
    model_nm: float = column(
        "by the record's model", unit="nm", format=".2f", help="Identified from the record"
    )
    agreement: str = column("agrees with its model", help="Whether the record does")


def given_controller(design: Design, model: IdentifiedModel) -> Controller:
    """Return a given controller at the frame rate of the record; refuse one of another loop."""
    path = model.hardware
    sizes = design.controller.D.shape
    if sizes != (path.n_commands, path.n_measurements):
        raise ProblemError(
            f"the gain file is of {sizes[1]} measurements and {sizes[0]} commands, and the record "
            f"has {path.modes} axes. Give one for this record, or choose the axes."
        )
    rate = 1 / design.controller.dt_s
    if not np.isclose(rate, path.frame_rate_hz, rtol=_SAME_RATE):
        raise ProblemError(
            f"the gain file is for {rate:.6g} Hz, and the record has {path.frame_rate_hz:.6g} Hz. "
            "Give one for this frame rate."
        )
    return replace(design.controller, dt_s=path.dt_s)


def given_design_row(
    name: str,
    design: Design,
    model: IdentifiedModel,
    replayed: PredictionRow | None,
) -> GivenDesignRow:
    """Return what a given design does on the record, replayed where its loop is stable."""
    controller = given_controller(design, model)
    loop = close_loop(model.hardware, controller)
    nominal = float(np.mean(model.sensor_gains))
    stable = ""
    if loop.is_stable:
        low, high = stable_sensor_gains(model.hardware, controller)
        stable = f"{low * nominal:.3g} to {high * nominal:.3g}"
    promised = design.rms
    return GivenDesignRow(
        design=name,
        method=design_title(design.method),
        stable=loop.is_stable,
        spectral_radius=loop.spectral_radius,
        stable_gains=stable,
        sensor_gain=f"{nominal:.3f}",
        replayed_nm=np.nan if replayed is None else replayed.replayed_nm,
        replayed_error_nm=np.nan if replayed is None else replayed.replayed_error_nm,
        own_model_nm=promised,
        model_nm=np.nan if replayed is None else replayed.model_nm,
        agreement=_agreement(promised, replayed),
    )


def _agreement(promised_nm: float, replayed: PredictionRow | None) -> str:
    """Say whether the data agree with the residual that the design's own model promises."""
    if replayed is None or not promised_nm > 0 or not replayed.replayed_nm > 0:
        return "not known"
    ratio = replayed.replayed_nm / promised_nm
    # the error of the logarithm, so that a large residual does not excuse itself
    if abs(np.log(ratio)) <= _SIGMAS * replayed.replayed_error_nm / replayed.replayed_nm:
        return "yes"
    if abs(ratio - 1) <= _AGREES:
        return f"yes, within {100 * _AGREES:.0f} %"
    return f"no: {'more' if ratio > 1 else 'less'} than promised, by a factor {ratio:.2f}"


def design_differences(design: Design, model: IdentifiedModel) -> list[str]:
    """Say how the loop that a design was made for differs from that of the record."""
    if design.hardware is None:
        return []
    own = design.hardware
    notes = []
    sensor = np.diag(own.sensor) if own.sensor.shape == (own.modes, own.modes) else np.zeros(0)
    if sensor.size == len(model.axes):
        for i, (axis, assumed) in enumerate(zip(model.axes, sensor.tolist(), strict=True)):
            error = axis.sensor_gain_error
            if error is not None and abs(assumed - axis.sensor_gain) > _SIGMAS * error:
                notes.append(
                    f"the gain file assumes a sensor gain of {assumed:.3f} on axis {i}; the record "
                    f"has {axis.sensor_gain:.3f} +- {error:.3f}"
                )
    here = replace(model.hardware, sensor_matrix=own.sensor, influence_matrix=own.influence)
    return [*notes, *(f"the gain file was {text}" for text in loop_differences(own, here))]
