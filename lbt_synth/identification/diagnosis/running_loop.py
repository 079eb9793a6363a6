"""The loop that ran: its commands, its control law, and the identified sensor gain."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.plausibility import law_controller
from lbt_synth.identification.commands.verdict import CommandVerdict
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.storage.rows import column, percent_column, table_row

_FIND = "find the commands that belong to these measurements"
_KNOWN = 0.05  # part of the increments that a law may leave, to be taken for the controller


@table_row
class LawRow:
    """The control law of a record, in words."""

    law: str = column("control law", help="Kind of the law")
    order: int = column("order", help="Past commands that it uses")
    gain: str = column("gain", help="Command per measurement, at low frequencies")
    axes: str = column("axes", help="Which axes move which")
    leak: str = column("pole nearest 1", help="Leak: 1 is a pure integrator")
    lag_frames: int = column(
        "late", unit="frames", help="Lag of the first measurement, 0 if nothing is late"
    )
    residual: float = percent_column(
        "unexplained",
        format=".2g",
        help="Part of the variance of the commands' increments that it leaves unexplained",
    )
    coherence: float = column(
        help="Part of what past commands leave of the increments that follows from measurements"
    )


@table_row
class LoopRow:
    """The loop that ran, by its law and the model."""

    delay_frames: float = column("delay", unit="frames", help="Total delay, as given")
    sensor_gain: str = column("sensor gain", help="Sensor gain of each axis, with its error")
    sensor_gain_note: str = column(help="Where the sensor gain is from")
    spectral_radius: float = column("spectral radius", format=".5f", help="1 and more is unstable")
    stable_gains: str = column("stable sensor gains", help="Real sensor gains that are stable")
    modulus: float = column("modulus margin", format=".3f", help="Distance from instability")
    crossover_hz: float = column("crossover", unit="Hz", format=".3g", help="Highest crossover")


def law_row(law: ControlLaw) -> LawRow:
    """Return a control law in words."""
    if law.kind == "none":
        return LawRow(
            law="none: the commands do not follow from the measurements",
            order=0,
            gain="",
            axes="",
            leak="",
            lag_frames=0,
            residual=law.residual,
            coherence=law.coherence,
        )
    matrix = law.axis_matrix
    gains = law.gain
    flat = np.diag(gains) if matrix.kind == "diagonal" else gains.ravel()
    return LawRow(
        law=law.kind,
        order=law.order,
        gain=", ".join(_distinct(f"{value:.4g}" for value in flat + 0.0)),
        axes="" if len(gains) == 1 else matrix.kind,
        leak=", ".join(_distinct(f"{value:.5g}" for value in law.leak if np.isfinite(value))),
        lag_frames=law.lag_frames,
        residual=0.0 if law.exact else law.residual,
        coherence=law.coherence,
    )


def _distinct(texts: Iterable[str]) -> list[str]:
    """Return texts, or one of them where all are the same."""
    listed = list(texts)
    return listed[:1] if len(set(listed)) == 1 else listed


def running_controller(law: ControlLaw | None, frame_rate_hz: float) -> Controller | None:
    """Return the controller that ran, None where its law is not known well enough."""
    if law is None or law.kind == "none" or law.lag_frames < 0 or law.residual > _KNOWN:
        return None
    return law_controller(law, frame_rate_hz)


def loop_row(model: IdentifiedModel, running: Controller | None) -> LoopRow:
    """Return the loop that ran, with what is known of its stability."""
    gains = [
        f"{axis.sensor_gain:.3f}"
        + ("" if axis.sensor_gain_error is None else f" +- {axis.sensor_gain_error:.3f}")
        for axis in model.axes
    ]
    notes = [axis.sensor_gain_note for axis in model.axes]
    radius = modulus = crossover = np.nan
    stable = ""
    if running is not None:
        loop = close_loop(model.hardware, running)
        radius = loop.spectral_radius
        if loop.is_stable:
            margins = loop_margins(loop)
            modulus, crossover = margins.modulus, margins.crossover_hz
            nominal = float(np.mean(model.sensor_gains))
            low, high = margins.gain_low * nominal, margins.gain_high * nominal
            stable = f"{low:.3g} to {high:.3g}"
        else:
            stable = "unstable at this one"
    return LoopRow(
        delay_frames=model.delay_frames,
        sensor_gain=", ".join(_distinct(gains)),
        sensor_gain_note=", ".join(_distinct(notes)),
        spectral_radius=radius,
        stable_gains=stable,
        modulus=modulus,
        crossover_hz=crossover,
    )


@table_row
class CommandRow:
    """How the commands of a record reach its measurements."""

    explanation: str = column("the commands", help="What explains the record best")
    nats: float = column(
        "evidence", format=".0f", help="Log-likelihood over that of the record as given"
    )
    repair: str = column("repair", help="Options that repair the record")


def command_row(verdict: CommandVerdict) -> CommandRow:
    """Return the verdict on the commands as a row."""
    return CommandRow(
        explanation=verdict.explanation,
        nats=verdict.nats,
        repair=verdict.options,
    )


def doubt_commands(verdict: CommandVerdict | None) -> tuple[str, str]:
    """Say what is wrong with the commands, and what to do; empty if nothing is."""
    if verdict is None:
        return "", ""
    if not verdict.accepted:
        if verdict.options:
            return verdict.explanation, f"read the record with {verdict.options}"
        what, _, advice = verdict.explanation.partition(". ")
        return what, advice[:1].lower() + advice[1:] or _FIND
    return ("", "") if verdict.law is None else _doubt_law(verdict.law)


def _doubt_law(law: ControlLaw) -> tuple[str, str]:
    """Say what is wrong by the law alone, for records too short for anything else."""
    matrix = law.axis_matrix
    if not law.exact:
        return "", ""
    if matrix.kind == "diagonal" and min(matrix.signs) < 0:
        return "by their law they have the opposite sign", "turn their sign"
    if matrix.kind == "swapped":
        return "by their law those of the two axes are exchanged", "exchange them"
    if law.kind == "proportional":
        return "by their law they are increments, not positions", "add them up"
    return "", ""
