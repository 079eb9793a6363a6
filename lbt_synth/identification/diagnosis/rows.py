"""The rows of a diagnosis: channels, the loop that ran, a given design, lines, and their costs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.control_law import ControlLaw, law_controller
from lbt_synth.identification.fit.identified_model import (
    DIFFERENT,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.prediction.comparison import PredictionRow
from lbt_synth.identification.records.from_series import TREND, end_scatters
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl, loop_margins, residual_budget
from lbt_synth.loop.budget import line_covariance
from lbt_synth.loop.stable_range import stable_sensor_gains
from lbt_synth.methods.registry import design_title
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.loop_hardware import loop_differences
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

_STABLE_GAINS = "stable sensor gains"
AXES = ("tip", "tilt")
_DEAD = 0.5  # of the frames, on one value
_NOISIER = 3.0  # times the other axis
FEW = 0.01  # of the frames, that may have a fault
DEAD = "dead"
_WHOLE = ("noisy", "drifting", "scatter changes")  # what concerns the whole channel
_WORDS = {"saturated": "clipped", "stuck": "stuck", "outlier": "outliers", "held": "held"}
_SAME_RATE = 1e-3
_AGREES = 0.1  # of the residual that its own model promises: what conditions change
_ALL = "all"  # parts together


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


def running_controller(law: ControlLaw | None, frame_rate_hz: float) -> Controller | None:
    """Return the controller that ran, None where its law is not known well enough."""
    if law is None or not law.is_sure or law.lag_frames < 0:
        return None
    return law_controller(law, frame_rate_hz)


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
        if loop.is_stable:
            margins = loop_margins(loop)
            modulus, crossover = margins.modulus, margins.crossover_hz
        stable = _stable_gains(model, running)
    return facts(
        delay_frames=fact(model.delay_frames, "delay", unit="frames"),
        sensor_gain=fact(", ".join(_distinct(gains)), "sensor gain"),
        sensor_gain_note=fact(", ".join(_distinct(notes))),
        spectral_radius=fact(radius, "spectral radius", format=".5f"),
        stable_gains=fact(stable or "unstable at this one" * (running is not None), _STABLE_GAINS),
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


@table_row
class ChannelRow:
    """One channel of a record."""

    channel: str = column("channel", help="What it is")
    rms_nm: float = nm_column("rms", help="Deviation from its mean")
    step_nm: float = column(
        "frame to frame", unit="nm", format=".3g", help="Rms difference of two frames"
    )
    mean_nm: float = column(unit="nm", help="Mean")
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
    axes = range(record.axes)
    rows = [_judge_channel(record, axis, record.measurements, record.measured) for axis in axes]
    if record.commands is not None:
        rows += [_judge_channel(record, axis, record.commands, record.commanded) for axis in axes]
    return tuple(rows)


def live_axes(record: LoopRecord) -> list[int]:
    """Return the axes whose measurements are not dead."""
    rows = judge_channels(record)[: record.axes]
    return [axis for axis, row in enumerate(rows) if row.state != DEAD]


def _judge_channel(
    record: LoopRecord, axis: int, values: FloatArray, good: BoolArray
) -> ChannelRow:
    """Return what is known of one column of the measurements or commands, (frames, axes)."""
    series = "measurements" if values is record.measurements else "commands"
    findings = [
        finding
        for finding in record.health.findings
        if (finding.series, finding.axis) == (series, axis) and finding.kind in _WORDS
    ]
    channel, steps = values[:, axis], [_step_rms(column, good) for column in values.T]
    here = channel[good] if good.any() else channel
    first, last = end_scatters(channel, good)
    change, quarter = last / first if first > 0 else np.nan, len(here) // 4
    drift = float(np.mean(here[-quarter:]) - np.mean(here[:quarter])) if quarter else np.nan
    held = sum(finding.fraction for finding in findings if finding.kind in ("stuck", "held"))
    words = [f"{_WORDS[finding.kind]} ({100 * finding.fraction:.2g} %)" for finding in findings]
    if np.ptp(here) == 0 or held > _DEAD:
        words = [DEAD]
    elif series == "measurements":
        others = [step for i, step in enumerate(steps) if i != axis]
        faults = (
            bool(others) and steps[axis] > _NOISIER * max(others),
            record.commands is not None and abs(drift) > float(np.std(here)),
            change > TREND or change < 1 / TREND,
        )
        words += [word for word, is_so in zip(_WHOLE, faults, strict=True) if is_so]
    name = AXES[axis] if record.axes == len(AXES) else ""
    return ChannelRow(
        channel=f"{name} {series.removesuffix('s')}".strip(),
        rms_nm=float(np.std(here)),
        step_nm=steps[axis],
        mean_nm=float(np.mean(here)),
        drift_nm=drift,
        change=change,
        faulty=sum(finding.fraction for finding in findings),
        state=", ".join(words) or "good",
    )


def _step_rms(series: FloatArray, good: BoolArray) -> float:
    """Return the rms difference of neighbouring good frames, nan without any."""
    pairs = good[1:] & good[:-1]
    return float(np.sqrt(np.mean(np.diff(series)[pairs] ** 2))) if pairs.any() else np.nan


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


def given_design_facts(
    name: str,
    design: Design,
    model: IdentifiedModel,
    replayed: PredictionRow | None,
) -> Facts:
    """Return what a given design does on the record, replayed where its loop is stable."""
    controller = given_controller(design, model)
    promised = design.rms
    return facts(
        design=fact(name, "design"),
        method=fact(design_title(design.method), "method"),
        stable=fact(close_loop(model.hardware, controller).is_stable, "stable"),
        stable_gains=fact(_stable_gains(model, controller), _STABLE_GAINS),
        own_model_nm=fact(promised, "promised by its own model", unit="nm", format=".2f"),
        agreement=fact(_agreement(promised, replayed), "agrees with its model"),
    )


def _agreement(promised_nm: float, replayed: PredictionRow | None) -> str:
    """Say whether the data agree with the residual that the design's own model promises."""
    if replayed is None or not promised_nm > 0 or not replayed.replayed_nm > 0:
        return "not known"
    ratio = replayed.replayed_nm / promised_nm
    # the error of the logarithm, so that a large residual does not excuse itself
    error = replayed.replayed_error_nm / replayed.replayed_nm
    if abs(np.log(ratio)) <= max(DIFFERENT * error, _AGREES):
        return "yes"
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
            if error is not None and abs(assumed - axis.sensor_gain) > DIFFERENT * error:
                notes.append(
                    f"the gain file assumes a sensor gain of {assumed:.3f} on axis {i}; the record "
                    f"has {axis.sensor_gain:.3f} +- {error:.3f}"
                )
    here = replace(model.hardware, sensor_matrix=own.sensor, influence_matrix=own.influence)
    return [*notes, *(f"the gain file was {text}" for text in loop_differences(own, here))]


def disturbance_lines(model: IdentifiedModel) -> tuple[IdentifiedLine, ...]:
    """Return the resonances of a model that are no turbulence, by frequency."""
    parts = [part for part in model.parts if part.kind != "turbulence"]
    return tuple(sorted(parts, key=lambda part: part.frequency_hz))


def line_name(line: IdentifiedLine) -> str:
    """Return what a table of costs calls a resonance."""
    return f"{'line' if line.kind == 'line' else 'broad resonance'} at {line.frequency_hz:.4g} Hz"


def line_place(line: IdentifiedLine) -> str:
    """Return along what a line shakes, to go on in a sentence; empty of a loop of one axis."""
    direction = line.direction or (1.0,)
    if len(direction) == 1:
        return ""
    if np.count_nonzero(direction) == 1:
        return f" in {AXES[int(np.argmax(np.abs(direction)))]}"
    return f" along {line.direction_deg:.0f} deg"


@table_row
class CostRow:
    """One part of the disturbance, and what it costs two loops by the model."""

    part: str = column("part", help="Part of the disturbance")
    running_nm: float = nm_column("running", help="Residual that it leaves in the loop that ran")
    running_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    best_nm: float = nm_column("best design", help="Residual that it leaves in the best design")
    best_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    where: str = field(default="")  # along what a line shakes, to go on in a sentence


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
    tables = [_covariances(plant, lines, controller) for controller in (running, best)]
    names = next((list(table) for table in tables if table), [])
    where = {line_name(line): line_place(line) for line in lines}
    rows = []
    for name in names:
        numbers = [_rms_and_strehl(table, name, imaging) for table in tables]
        (running_nm, running_strehl), (best_nm, best_strehl) = numbers
        rows.append(
            CostRow(
                part=name,
                running_nm=running_nm,
                running_strehl=running_strehl,
                best_nm=best_nm,
                best_strehl=best_strehl,
                where=where.get(name, ""),
            )
        )
    by = "running_nm" if tables[0] else "best_nm"
    rows.sort(key=lambda row: (row.part == _ALL, -getattr(row, by)))
    return tuple(rows)


def _covariances(
    plant: TipTiltPlant, lines: Sequence[IdentifiedLine], controller: Controller | None
) -> dict[str, FloatArray]:
    """Return the covariance (n, n) of the residual by part, and of all; none of no stable loop."""
    if controller is None:
        return {}
    loop = close_loop(plant.hardware, controller)
    if not loop.is_stable:
        return {}
    budget = residual_budget(loop, plant, frame_means=True)
    out = {"turbulence": budget.turbulence_nm2, "measurement noise": budget.noise_nm2}
    for line in lines:  # two of one frequency are one part
        name = line_name(line)
        out[name] = out.get(name, 0.0) + line_covariance(loop, line.vibration())
    rest = budget.total_nm2 - np.sum(list(out.values()), axis=0)
    out["turbulence"] = out["turbulence"] + rest  # slow resonances are turbulence
    return out | {_ALL: budget.total_nm2}


def _rms_and_strehl(
    parts: Mapping[str, FloatArray], name: str, imaging: Imaging
) -> tuple[float, float]:
    """Return the rms that a part leaves, and the Strehl ratio that it costs."""
    if name not in parts:
        return np.nan, np.nan
    others = [parts[part] for part in parts if part not in (name, _ALL)]
    rest = np.sum(others, axis=0) if name != _ALL else 0 * parts[_ALL]
    strehl = jitter_strehl(parts[_ALL], imaging=imaging)
    rms_nm = float(np.sqrt(max(np.trace(parts[name]), 0.0)))
    return rms_nm, jitter_strehl(rest, imaging=imaging) - strehl
