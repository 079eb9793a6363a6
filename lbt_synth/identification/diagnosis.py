"""The autopsy of a record: all that it tells of its loop, in rows and in findings.

The verdict is in three sentences. Its residuals are those on the second half of the record, with
errors; the model says only how the variance of one divides among the parts of the disturbance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lbt_synth.design import Design, integrator
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification.commands.control_law import ControlLaw, law_controller
from lbt_synth.identification.commands.verdict import CommandVerdict, explain_commands
from lbt_synth.identification.fit.identified_model import (
    AXES,
    DIFFERENT,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.comparison import (
    INTEGRATOR,
    RAN,
    PredictionRow,
    PredictionTable,
    compare_designs,
)
from lbt_synth.identification.prediction.residual import MUCH, gather
from lbt_synth.identification.records.from_series import TREND, end_scatters
from lbt_synth.identification.records.record import FEW, LoopRecord, require_length, split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, loop_margins, residual_budget
from lbt_synth.loop.stable_range import stable_sensor_gains
from lbt_synth.methods.registry import METHODS, default_method, reference_methods
from lbt_synth.models import Truth
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, column, fact, facts, nm_column, table_row
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import BoolArray, FloatArray, require_instance

DEAD = "dead"
_NOISIER = 3.0  # times the other axis, from frame to frame: turbulence and lines are more alike
_WHOLE = ("noisy", "drifting", "scatter changes")  # what concerns the whole channel
_WORDS = {"saturated": "clipped", "stuck": "stuck", "outlier": "outliers"}
_NARROW = 0.3  # modulus margin: less is a gain margin below 1.4
_LEAST_SHARE = 0.05  # of the residual variance, of a part that is named


@table_row
class ChannelRow:
    """One channel of a record."""

    channel: str = column("channel")
    rms_nm: float = nm_column("rms")
    step_nm: float = column("frame to frame", unit="nm", format=".3g")  # rms difference
    drift_nm: float = nm_column("drift")  # mean of the last quarter less that of the first
    change: float = column("scatter, end/start", format=".2f")  # of rms differences, by quarters
    faulty: float = column()  # part of the frames with a fault of this channel
    state: str = column("state")  # what is wrong with it, or good

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
        for finding in record.findings
        if (finding.series, finding.axis) == (series, axis) and finding.kind in _WORDS
    }
    steps = np.diff(values, axis=0)[good[1:] & good[:-1]]
    steps_nm = np.sqrt(np.mean(steps**2, axis=0)) if steps.size else np.full(record.axes, np.nan)
    channel = values[good, axis] if good.any() else values[:, axis]
    first, last = end_scatters(values[:, axis], good)
    change, quarter = last / first if first > 0 else np.nan, len(channel) // 4
    drift_nm = np.mean(channel[-quarter:]) - np.mean(channel[:quarter]) if quarter else np.nan
    words = [f"{_WORDS[kind]} ({100 * share:.3g} %)" for kind, share in faults.items()]
    if np.ptp(channel) == 0 or faults.get("stuck", 0.0) > 1 / 2:
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
    leak = ", ".join(dict.fromkeys(f"{pole:.5g}" for pole in abs(law.poles[:, :1]).ravel()))
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
        coherence=fact(float(np.mean(law.axis_coherence))),
    )


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
        stable = "unstable at this one"
        if loop.is_stable:
            low, high = stable_sensor_gains(model.hardware, running)
            nominal = float(np.mean(model.sensor_gains))
            stable = f"{low * nominal:.3g} to {high * nominal:.3g}"
            margins = loop_margins(loop)
            modulus, crossover = margins.modulus, margins.crossover_hz
    return facts(
        delay_frames=fact(model.delay_frames, "delay", unit="frames"),
        sensor_gain=fact(", ".join(dict.fromkeys(gains)), "sensor gain"),
        sensor_gain_note=fact(", ".join(dict.fromkeys(notes))),
        spectral_radius=fact(radius, "spectral radius", format=".5f"),
        stable_gains=fact(stable, "stable sensor gains"),
        modulus=fact(modulus, "modulus margin", format=".3f"),
        crossover_hz=fact(crossover, "crossover", unit="Hz", format=".3g"),
    )


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


def given_design_notes(name: str, design: Design, model: IdentifiedModel) -> Iterator[str]:
    """Say how the loop of a given design differs from that of the record."""
    if (path := design.hardware) is None:
        return
    if path.sensor.shape == (path.modes, path.modes):
        for i, (axis, assumed) in enumerate(zip(model.axes, np.diag(path.sensor), strict=True)):
            error = axis.sensor_gain_error
            if error is not None and abs(assumed - axis.sensor_gain) > DIFFERENT * error:
                yield (
                    f"{name} assumes a sensor gain of {assumed:.3f} on axis {i}; the record has "
                    f"{axis.sensor_gain:.3f} +- {error:.3f}"
                )
    here = replace(model.hardware, sensor_matrix=path.sensor, influence_matrix=path.influence)
    yield from (f"{name} was {text}" for text in loop_differences(path, here))


def disturbance_lines(model: IdentifiedModel) -> tuple[IdentifiedLine, ...]:
    """Return the resonances of a model that are no turbulence, by frequency."""
    lines = [resonance for resonance in model.parts if resonance.kind != "turbulence"]
    return tuple(sorted(lines, key=lambda line: line.frequency_hz))


def line_name(line: IdentifiedLine) -> str:
    """Return what a table of costs calls a resonance, and along what it shakes."""
    kind = "line" if line.kind == "line" else "broad resonance"
    where = "" if line.direction in (None, (1.0,)) else f" ({line.axis_text(AXES)})"
    return f"{kind} at {line.frequency_hz:.4g} Hz{where}"


@table_row
class CostRow:
    """One part of the disturbance, and the residual that it leaves in two loops by the model."""

    part: str = column("part")
    running_nm: float = nm_column("running")
    best_nm: float = nm_column("best design")


def disturbance_costs(
    model: IdentifiedModel, running: Controller | None, best: Controller
) -> tuple[CostRow, ...]:
    """Return a row per part of the disturbance, the most costly first, and one of all."""
    ran, designed = (_costs(model, controller) for controller in (running, best))
    costs = ran or designed
    *parts, everything = costs
    order = [*sorted(parts, key=lambda name: -costs[name]), everything]
    return tuple(
        CostRow(part=name, running_nm=ran.get(name, np.nan), best_nm=designed.get(name, np.nan))
        for name in order
    )


def _costs(model: IdentifiedModel, controller: Controller | None) -> dict[str, float]:
    """Return the rms that each part leaves, and last that of all [nm]; none of no stable loop."""
    plant = model.plant()
    if controller is None or not (loop := close_loop(plant.hardware, controller)).is_stable:
        return {}
    budget = residual_budget(loop, plant, frame_means=True)
    parts = {"turbulence": 0.0, "measurement noise": float(np.trace(budget.noise_nm2))}
    for line in disturbance_lines(model):  # two of one frequency are one part
        alone = Truth(turbulence=None, vibrations=(line.vibration(),))
        rms_nm = residual_budget(loop, alone, frame_means=True).rms_nm
        parts[line_name(line)] = parts.get(line_name(line), 0.0) + rms_nm**2
    total = float(np.trace(budget.total_nm2))
    parts["turbulence"] = total - sum(parts.values())  # slow resonances are turbulence
    parts["all"] = total
    return {name: float(np.sqrt(max(variance, 0.0))) for name, variance in parts.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a record tells, and what it asks for."""

    tone: Literal["good", "note", "bad"] = "bad"
    sentence: str
    advice: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """What a record tells of its loop."""

    record: LoopRecord
    imaging: Imaging  # the camera of Strehl ratios
    commands: CommandVerdict | None = None  # how they reach the measurements; None of an open loop
    channels: tuple[ChannelRow, ...] = ()  # measurements and commands, one by one
    model: IdentifiedModel | None = None  # of the whole record
    loop: Facts | None = None  # that ran, by law and model
    # residuals on the second half of the record, by models of the first
    comparison: PredictionTable | None = None
    best: str = ""  # row of the comparison that leaves least, of the designs
    best_design: Design | None = None
    # what each part of the disturbance costs by the model of the first half, the most costly first;
    # the last row is all
    costs: tuple[CostRow, ...] = ()
    notes: tuple[str, ...] = ()  # what could not be said and why, and what else should be known

    @property
    def law(self) -> ControlLaw | None:
        """The law that computed the commands; None of an open loop, or of too few frames."""
        return None if self.commands is None else self.commands.law

    @property
    def doubt(self) -> str:
        """What is wrong with the commands; empty if nothing is."""
        return "" if self.commands is None else self.commands.doubt

    @property
    def residuals(self) -> tuple[PredictionRow, ...]:
        """Rows of the comparison, for tables."""
        return () if self.comparison is None else self.comparison.entries

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the record tells, the most urgent first; the last one is about its residual."""
        faults = list(_find_faults(self)) or [_judge_loop(self)]
        faults += _missed_by_the_model(self)
        return (*faults, Finding(sentence=_residual_text(self), advice=_advice_text(self)))

    @property
    def verdict(self) -> tuple[str, str, str]:
        """Three sentences: the record, what its residual is made of, what to change first."""
        *state, residual = self.findings
        advice = next(finding.advice for finding in (*state, residual) if finding.advice)
        return " ".join(finding.sentence for finding in state), residual.sentence, advice


def diagnose(
    record: LoopRecord,
    *,
    given: Mapping[str, Design] | None = None,
    imaging: Imaging | None = None,
    progress: Callable[[int], object] | None = None,
    **options: Any,
) -> Diagnosis:
    """Find what ran in a record, what is wrong with it, what it costs, and what would be better.

    Parameters
    ----------
    record : LoopRecord
        What the loop recorded; the delay of a closed loop must be known.
    given : mapping of str to Design, optional
        Designs to try on the record, by their names.
    imaging : Imaging, optional
        The camera, for Strehl ratios; 2.2 um by default.
    progress : callable, optional
        Called with 1 after each of 3 steps.
    **options
        As :func:`identify` takes them.

    Returns
    -------
    Diagnosis
        Rows for tables, and what they are made from.

    Raises
    ------
    ProblemError
        If a given design is of another kind of loop, or an option is out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=500)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.1).controller,
    ...     lbt.Truth(turbulence=slow, noise_nm=5.0),
    ...     hardware=path,
    ...     frames=10_000,
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> diagnosis = lbt.identification.diagnose(record)
    >>> diagnosis.law.kind, [row.part for row in diagnosis.costs]
    ('integrator', ['turbulence', 'measurement noise', 'all'])
    """
    require_instance(record, LoopRecord)
    step, designs, notes = progress or (lambda _: None), given or {}, list[str]()
    commands = None
    if record.commands is not None:
        commands = explain_commands(record, sensor_gain=options.get("sensor_gain"))
        notes += commands.notes
    diagnosis = Diagnosis(
        record=record,
        imaging=imaging or Imaging(),
        commands=commands,
        channels=judge_channels(record),
    )
    step(1)
    if diagnosis.doubt:
        notes += ["the given design was not tried: the commands are not right"] * bool(designs)
        return replace(diagnosis, notes=tuple(notes))
    try:
        require_length(record)
        model = identify(record, **options)
    except LbtSynthError as error:
        return replace(diagnosis, notes=(*notes, f"no model: {error}"))
    step(1)
    law, running = diagnosis.law, None
    if law is not None and law.is_sure and law.lag_frames >= 0:
        running = law_controller(law, model.frame_rate_hz)
    controllers = {name: given_controller(design, model) for name, design in designs.items()}
    notes += model.notes
    for name, design in designs.items():
        notes += given_design_notes(name, design, model)
    diagnosis = replace(diagnosis, model=model, loop=loop_facts(model, running))
    try:
        diagnosis = _compare(diagnosis, model, running, controllers, options)
    except LbtSynthError as error:
        notes.append(f"no comparison on unseen data: {error}")
    step(1)
    notes += [] if diagnosis.comparison is None else diagnosis.comparison.notes
    return replace(diagnosis, notes=tuple(notes))


def _compare(
    diagnosis: Diagnosis,
    model: IdentifiedModel,
    running: Controller | None,
    given: Mapping[str, Controller],
    options: Mapping[str, Any],
) -> Diagnosis:
    """Add residuals on the second half, the best design, and costs, by a model of the first."""
    record, imaging = diagnosis.record, diagnosis.imaging
    # a half shows the sensor gain less well
    fixed = {"start": model, "sensor_gain": list(model.sensor_gains)}
    half = identify(split_halves(record)[0], **{**options, **fixed})
    more = [m for m in METHODS.values() if m.plant_section is not None or m.of_record]
    names = [m.name for m in (*reference_methods(estimators_only=True), *more)]
    table, designs = compare_designs(
        record, half, {name: {} for name in names}, others=given, running=running, imaging=imaging
    )
    plant = half.plant()
    designs[INTEGRATOR] = integrator(plant.hardware, truth=plant)  # the comparison has it
    residuals = {row.name: row.replayed.safe_nm2 for row in table.entries if row.replayed}
    best = min(designs, key=lambda name: residuals[name])
    costs = disturbance_costs(half, running, designs[best].controller)
    return replace(diagnosis, comparison=table, best=best, best_design=designs[best], costs=costs)


def _find_faults(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Yield what must be changed before anything else can be said."""
    bad = [row for row in diagnosis.channels if row.serious]
    faults = [f"the {row.channel} is {row.state}" for row in bad]
    if diagnosis.record.lost > FEW:
        faults.append(f"{100 * diagnosis.record.lost:.3g} % of the frames are lost")
    if faults:
        advice = f"First look at the {bad[0].channel}, which is {bad[0].state}." if bad else ""
        yield Finding(sentence=f"The record has faults: {'; '.join(faults)}.", advice=advice)
    if diagnosis.commands is not None and diagnosis.doubt:
        yield Finding(
            sentence=f"The commands are not those that the mirror followed: {diagnosis.doubt}.",
            advice=f"First {diagnosis.commands.advice}.",
        )


def _missed_by_the_model(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Say where the model misses what past readings tell: a predictor leaves clearly less."""
    rows = {row.name: row.replayed for row in diagnosis.residuals}
    model = rows.get(METHODS[default_method()].title)
    data = next((rows.get(m.title) for m in METHODS.values() if m.of_record), None)
    if model and data and model.is_clearly_above(data):
        low, high = (diagnosis.record.frame_rate_hz * end for end in model.excess_band(data))
        less_nm = nm_text(float(np.sqrt(model.total_nm2 - data.total_nm2)))
        yield Finding(
            tone="note",
            sentence=f"The model misses {less_nm} that past readings tell, above all between "
            f"{low:.0f} and {high:.0f} Hz.",
        )


def _judge_loop(diagnosis: Diagnosis) -> Finding:
    """Say what ran, and whether it was stable."""
    law, loop = "an open loop ran", diagnosis.loop
    if diagnosis.law is not None:
        law = f"{diagnosis.law.name} ran{diagnosis.law.lag_text}"
    elif diagnosis.commands is not None:
        law = "so few frames do not tell which law ran"
    if loop is None:
        return Finding(tone="note", sentence=f"The record shows no fault, and {law}.")
    gain = f"at the sensor gain of {loop.sensor_gain}"
    if loop.spectral_radius >= 1:
        return Finding(sentence=f"The record shows no fault, but {law}, which is UNSTABLE {gain}.")
    stable = f", stable {gain}" if loop.stable_gains else ""
    narrow = bool(loop.modulus < _NARROW)
    if narrow:
        stable += f" but with a modulus margin of {loop.modulus:.2g} only"
    sentence = f"The record is sound: {law}{stable}."
    return Finding(tone="note" if narrow else "good", sentence=sentence)


def _residual_text(diagnosis: Diagnosis) -> str:
    """Say what the loop that ran leaves, from which measurement that follows, and of what it is."""
    row = next((row for row in diagnosis.residuals if row.name == RAN), None)
    ran = None if row is None else row.replayed
    parts = _parts_text(diagnosis, "best_nm" if ran is None else "running_nm")
    if row is None or ran is None:
        if not parts:
            return "Nothing can be said of its residual."
        return f"What the {diagnosis.best} would leave is by the model {parts}."
    y = gather(diagnosis.record.measurements, ran.stretches)
    measured_nm = float(np.sqrt(np.mean(np.sum(y**2, axis=1))))
    noise_nm = float(np.sqrt(np.trace(ran.noise_nm2)))
    by_model = f": by the model {parts}" if parts else ""
    if row.contradicts_model:
        by_model += f"; the data contradict the model, which expects {nm_text(row.model_nm)}"
    return (
        f"It leaves {ran.text} on unseen data ({nm_text(measured_nm)} were measured at this sensor "
        f"gain, and {nm_text(noise_nm)} are noise){by_model}."
    )


def _parts_text(diagnosis: Diagnosis, field: str) -> str:
    """Say which parts of a residual variance are how large by the model, the largest first."""
    named = []
    for row in diagnosis.costs[:-1]:
        share = (getattr(row, field) / getattr(diagnosis.costs[-1], field)) ** 2
        if share >= _LEAST_SHARE:  # not of a residual that is not known
            named.append(f"{100 * share:.0f} % of the {row.part}")
    return listing_text(named)


def _advice_text(diagnosis: Diagnosis) -> str:
    """Say what to change first in a loop whose record has no fault."""
    name, residuals = diagnosis.best, {row.name: row.replayed for row in diagnosis.residuals}
    ran, best, slow = (residuals.get(row) for row in (RAN, name, INTEGRATOR))
    if best is None or slow is None:
        return "Record longer before anything is changed."
    if ran is None:
        return f"The {name} leaves least on unseen data: {best.text}."
    if not ran.is_clearly_above(best):
        return f"Change nothing: of all that was tried the {name} leaves least, {best.text}."
    if ran.is_clearly_above(slow) and slow.total_nm2 < MUCH**2 * best.total_nm2:
        alternative = "" if name == INTEGRATOR else f", the {name} {best.text}"
        return (
            f"First change the gain{_gain_text(diagnosis)}: the {INTEGRATOR} leaves {slow.text} on "
            f"unseen data{alternative}."
        )
    return (
        f"First change the controller: the {name} leaves {best.text} on unseen data. The "
        f"{INTEGRATOR} leaves {slow.text}."
    )


def _gain_text(diagnosis: Diagnosis) -> str:
    """Say from which gain to which, where an integrator ran."""
    law = diagnosis.law
    if law is None or law.order != 1 or diagnosis.model is None:
        return ""
    plant = diagnosis.model.plant()
    design = integrator(plant.hardware, truth=plant)
    best = float(np.mean(np.diag(design.controller.B)))
    return f" from {float(np.mean(np.diag(law.gain))):.3g} to {best:.3g}"
