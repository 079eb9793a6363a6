"""The rows of a diagnosis: channels, the loop that ran, a given design, lines, and their costs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.fit.identified_model import (
    DIFFERENT,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.records.from_series import TREND, end_scatters
from lbt_synth.identification.records.record import FEW, LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl, loop_margins, residual_budget
from lbt_synth.loop.budget import line_covariance
from lbt_synth.loop.stable_range import stable_sensor_gains
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import (
    Facts,
    column,
    fact,
    facts,
    nm_column,
    percent_column,
    table_row,
)
from lbt_synth.validation import BoolArray, FloatArray

AXES = ("tip", "tilt")
DEAD = "dead"
_NOISIER = 3.0  # times the other axis, from frame to frame: turbulence and lines are more alike
_WHOLE = ("noisy", "drifting", "scatter changes")  # what concerns the whole channel
_WORDS = {"saturated": "clipped", "stuck": "stuck", "outlier": "outliers", "held": "held"}
_ALL = "all"  # parts together


@table_row
class ChannelRow:
    """One channel of a record."""

    channel: str = column("channel", help="What it is")
    rms_nm: float = nm_column("rms", help="Deviation from its mean")
    step_nm: float = column(
        "frame to frame", unit="nm", format=".3g", help="Rms difference of two frames"
    )
    drift_nm: float = nm_column("drift", help="Mean of the last quarter less that of the first")
    change: float = column(
        "scatter, end/start", format=".2f", help="Rms difference, last quarter over first"
    )
    faulty: float = column(help="Part of the frames with a fault of this channel")
    state: str = column("state", help="What is wrong with it, or good")

    @property
    def serious(self) -> bool:
        """Whether something is wrong with it that more than a few frames have."""
        return self.state == DEAD or self.faulty > FEW or any(map(self.state.count, _WHOLE))


def judge_channels(record: LoopRecord) -> tuple[ChannelRow, ...]:
    """Return what is known of each channel of a record, the measurements first."""
    channels = [
        ("measurements", record.measurements, record.measured),
        ("commands", record.commands, record.commanded),
    ]
    return tuple(
        _judge_channel(record, series, axis, values, good)
        for series, values, good in channels
        if values is not None
        for axis in range(record.axes)
    )


def live_axes(record: LoopRecord) -> list[int]:
    """Return the axes whose measurements are not dead."""
    rows = judge_channels(record)[: record.axes]
    return [axis for axis, row in enumerate(rows) if row.state != DEAD]


def _judge_channel(
    record: LoopRecord, series: str, axis: int, values: FloatArray, good: BoolArray
) -> ChannelRow:
    """Return what is known of one column of the measurements or commands, (frames, axes)."""
    faults = {
        finding.kind: finding.fraction
        for finding in record.health.findings
        if (finding.series, finding.axis) == (series, axis) and finding.kind in _WORDS
    }
    steps = np.diff(values, axis=0)[good[1:] & good[:-1]]
    steps_nm = np.sqrt(np.mean(steps**2, axis=0)) if steps.size else np.full(record.axes, np.nan)
    channel = values[good, axis] if good.any() else values[:, axis]
    first, last = end_scatters(values[:, axis], good)
    change, quarter = last / first if first > 0 else np.nan, len(channel) // 4
    drift_nm = np.mean(channel[-quarter:]) - np.mean(channel[:quarter]) if quarter else np.nan
    words = [f"{_WORDS[kind]} ({100 * share:.2g} %)" for kind, share in faults.items()]
    held = faults.get("stuck", 0.0) + faults.get("held", 0.0)
    if np.ptp(channel) == 0 or held > 1 / 2:
        words = [DEAD]
    elif series == "measurements":
        is_so = (
            steps_nm[axis] > _NOISIER * np.max(np.delete(steps_nm, axis), initial=0.0) > 0,
            record.commands is not None and abs(drift_nm) > np.std(channel),
            change > TREND or change < 1 / TREND,
        )
        words += [word for word, so in zip(_WHOLE, is_so, strict=True) if so]
    name = AXES[axis] if record.axes == len(AXES) else ""
    return ChannelRow(
        channel=f"{name} {series.removesuffix('s')}".strip(),
        rms_nm=float(np.std(channel)),
        step_nm=float(steps_nm[axis]),
        drift_nm=float(drift_nm),
        change=float(change),
        faulty=sum(faults.values()),
        state=", ".join(words) or "good",
    )


def law_facts(law: ControlLaw) -> Facts:
    """Return a control law in words."""
    is_none = law.kind == "none"
    leak = ", ".join(_distinct(f"{value:.5g}" for value in law.leak if np.isfinite(value)))
    none = "none: the commands do not follow from the measurements"
    axes = "" if is_none or len(law.gain) == 1 else law.axes_kind
    unexplained = 0.0 if law.exact else law.residual
    return facts(
        law=fact(none if is_none else law.kind, "control law"),
        order=fact(law.order, "order"),
        gain=fact("" if is_none else law.gain_text, "gain"),
        axes=fact(axes, "axes"),
        leak=fact(leak, "pole nearest 1"),
        lag_frames=fact(law.lag_frames, "late", unit="frames"),
        residual=fact(unexplained, "unexplained", unit="%", scale=100, format=".2g"),
        coherence=fact(law.coherence),
    )


def _distinct(texts: Iterable[str]) -> list[str]:
    """Return texts, or one of them where all are the same."""
    listed = list(texts)
    return listed[:1] if len(set(listed)) == 1 else listed


def loop_facts(model: IdentifiedModel, running: Controller | None) -> Facts:
    """Return the loop that ran, by its law and the model, with what is known of its stability."""
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
        stable = _stable_gains(model, running) or "unstable at this one"
        if loop.is_stable:
            margins = loop_margins(loop)
            modulus, crossover = margins.modulus, margins.crossover_hz
    return facts(
        delay_frames=fact(model.delay_frames, "delay", unit="frames"),
        sensor_gain=fact(", ".join(_distinct(gains)), "sensor gain"),
        sensor_gain_note=fact(", ".join(_distinct(notes))),
        spectral_radius=fact(radius, "spectral radius", format=".5f"),
        stable_gains=fact(stable, "stable sensor gains"),
        modulus=fact(modulus, "modulus margin", format=".3f"),
        crossover_hz=fact(crossover, "crossover", unit="Hz", format=".3g"),
    )


def _stable_gains(model: IdentifiedModel, controller: Controller) -> str:
    """Return the real sensor gains at which the loop is stable, empty if not at the model's."""
    if not close_loop(model.hardware, controller).is_stable:
        return ""
    nominal = float(np.mean(model.sensor_gains))
    low, high = stable_sensor_gains(model.hardware, controller)
    return f"{low * nominal:.3g} to {high * nominal:.3g}"


def given_controller(design: Design, model: IdentifiedModel) -> Controller:
    """Return a given controller at the frame rate of the record; refuse one of another loop."""
    path = model.hardware
    sizes, rate = design.controller.D.shape, 1 / design.controller.dt_s
    if sizes != (path.n_commands, path.n_measurements):
        raise ProblemError(
            f"the gain file is of {sizes[1]} measurements and {sizes[0]} commands, and the record "
            f"has {path.modes} axes. Give one for this record, or choose the axes."
        )
    if round(rate / path.frame_rate_hz, 2) != 1:
        raise ProblemError(
            f"the gain file is for {rate:.6g} Hz, and the record has {path.frame_rate_hz:.6g} Hz. "
            "Give one for this frame rate."
        )
    return replace(design.controller, dt_s=path.dt_s)


def given_design_notes(name: str, design: Design, model: IdentifiedModel) -> list[str]:
    """Say what a given design promises, and how its loop differs from that of the record."""
    stable = _stable_gains(model, given_controller(design, model))
    notes = [
        f"{name} promises {nm_text(design.rms)} by its own model, and its loop is "
        f"{f'stable at sensor gains of {stable}' if stable else 'unstable'}"
    ]
    if (path := design.hardware) is None:
        return notes
    if path.sensor.shape == (path.modes, path.modes):
        for i, (axis, assumed) in enumerate(zip(model.axes, np.diag(path.sensor), strict=True)):
            error = axis.sensor_gain_error
            if error is not None and abs(assumed - axis.sensor_gain) > DIFFERENT * error:
                notes.append(
                    f"{name} assumes a sensor gain of {assumed:.3f} on axis {i}; the record has "
                    f"{axis.sensor_gain:.3f} +- {error:.3f}"
                )
    here = replace(model.hardware, sensor_matrix=path.sensor, influence_matrix=path.influence)
    return [*notes, *(f"{name} was {text}" for text in loop_differences(path, here))]


def disturbance_lines(model: IdentifiedModel) -> tuple[IdentifiedLine, ...]:
    """Return the resonances of a model that are no turbulence, by frequency."""
    parts = [part for part in model.parts if part.kind != "turbulence"]
    return tuple(sorted(parts, key=lambda part: part.frequency_hz))


def line_name(line: IdentifiedLine) -> str:
    """Return what a table of costs calls a resonance, and along what it shakes."""
    kind = "line" if line.kind == "line" else "broad resonance"
    name, direction = f"{kind} at {line.frequency_hz:.4g} Hz", line.direction or (1.0,)
    if len(direction) == 1:
        return name
    if np.count_nonzero(direction) == 1:
        return f"{name} in {AXES[int(np.argmax(np.abs(direction)))]}"
    return f"{name} along {line.direction_deg:.0f} deg"


@table_row
class CostRow:
    """One part of the disturbance, and what it costs two loops by the model."""

    part: str = column("part", help="Part of the disturbance")
    running_nm: float = nm_column("running", help="Residual that it leaves in the loop that ran")
    running_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    best_nm: float = nm_column("best design", help="Residual that it leaves in the best design")
    best_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")


def disturbance_costs(
    plant: TipTiltPlant,
    lines: Sequence[IdentifiedLine],
    running: Controller | None,
    best: Controller | None,
    imaging: Imaging,
) -> tuple[CostRow, ...]:
    """Return a row per part of the disturbance, the most costly first, and one of all.

    The Strehl ratio that a part costs is that of the residual without it, less that with it: as
    residuals add up in the exponent, these do not add up to the whole loss.
    """
    ran, designed = (_costs(plant, lines, controller, imaging) for controller in (running, best))
    costs = ran or designed
    order = sorted(costs, key=lambda name: (name == _ALL, -costs[name][0]))
    unknown = np.nan, np.nan
    return tuple(
        CostRow(
            part=name,
            running_nm=ran.get(name, unknown)[0],
            running_strehl=ran.get(name, unknown)[1],
            best_nm=designed.get(name, unknown)[0],
            best_strehl=designed.get(name, unknown)[1],
        )
        for name in order
    )


def _costs(
    plant: TipTiltPlant,
    lines: Sequence[IdentifiedLine],
    controller: Controller | None,
    imaging: Imaging,
) -> dict[str, tuple[float, float]]:
    """Return rms and lost Strehl ratio by part, and of all; none of no stable loop."""
    if controller is None or not (loop := close_loop(plant.hardware, controller)).is_stable:
        return {}
    budget = residual_budget(loop, plant, frame_means=True)
    parts = {"turbulence": budget.turbulence_nm2, "measurement noise": budget.noise_nm2}
    for line in lines:  # two of one frequency are one part
        name = line_name(line)
        parts[name] = parts.get(name, 0.0) + line_covariance(loop, line.vibration())
    total = budget.total_nm2
    # slow resonances are turbulence
    parts["turbulence"] = parts["turbulence"] + total - np.sum(list(parts.values()), axis=0)
    strehl = jitter_strehl(total, imaging=imaging)
    costs = {}
    for name, covariance in {**parts, _ALL: total}.items():
        others = [parts[other] for other in parts if other != name] if name != _ALL else []
        rest = np.sum(others, axis=0) if others else 0 * total
        rms_nm = float(np.sqrt(max(np.trace(covariance), 0.0)))
        costs[name] = rms_nm, jitter_strehl(rest, imaging=imaging) - strehl
    return costs
