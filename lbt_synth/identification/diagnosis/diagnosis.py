"""The autopsy of a record: all that it tells of its loop, in rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.verdict import CommandVerdict, explain_commands
from lbt_synth.identification.diagnosis.rows import (
    ChannelRow,
    CostRow,
    design_differences,
    disturbance_costs,
    disturbance_lines,
    given_controller,
    given_design_facts,
    judge_channels,
    loop_facts,
    running_controller,
)
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.comparison import (
    INTEGRATOR,
    PredictionRow,
    PredictionTable,
    compare_on_record,
    stable_designs,
)
from lbt_synth.identification.prediction.residual import ResidualEstimate
from lbt_synth.identification.records.record import LoopRecord, require_length
from lbt_synth.identification.stretches import split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop
from lbt_synth.methods.registry import METHODS, reference_methods
from lbt_synth.storage.rows import Facts
from lbt_synth.validation import require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """What a record tells of its loop.

    Attributes
    ----------
    record : LoopRecord
        The record.
    imaging : Imaging
        The camera of Strehl ratios.
    commands : CommandVerdict or None
        How the commands reach the measurements; None of an open loop.
    channels : tuple of ChannelRow
        Measurements and commands, one by one.
    model : IdentifiedModel or None
        The model of the whole record, and why there is none in ``notes``.
    loop : Facts or None
        The loop that ran, by law and model.
    lines : tuple of IdentifiedLine
        Resonances that are no turbulence, by frequency.
    comparison : PredictionTable or None
        Residuals on the second half of the record, by models of the first.
    best : str
        Row of the comparison that leaves least, of the designs.
    best_design : Design or None
        The same design, for the model of the first half.
    costs : tuple of CostRow
        What each part of the disturbance costs by the model of the first half (of the whole record
        where there is no comparison), the most costly first; the last row is all.
    given : Facts or None
        A given design on this record.
    notes : tuple of str
        What could not be said and why, and what else should be known.
    """

    record: LoopRecord
    imaging: Imaging
    commands: CommandVerdict | None = None
    channels: tuple[ChannelRow, ...] = ()
    model: IdentifiedModel | None = None
    loop: Facts | None = None
    lines: tuple[IdentifiedLine, ...] = ()
    comparison: PredictionTable | None = None
    best: str = ""
    best_design: Design | None = None
    costs: tuple[CostRow, ...] = ()
    given: Facts | None = None
    notes: tuple[str, ...] = ()

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

    def row(self, name: str) -> PredictionRow | None:
        """Return a row of the comparison, None where there is none."""
        return next((row for row in self.residuals if row.name == name), None)

    def residual(self, name: str) -> ResidualEstimate | None:
        """Return the residual on unseen data of a row, None where there is none."""
        row = self.row(name)
        return None if row is None else row.replayed


def diagnose(
    record: LoopRecord,
    *,
    given: Mapping[str, Design] | None = None,
    whole: LoopRecord | None = None,
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
        One design to try on the record, by its name.
    whole : LoopRecord, optional
        The record with those axes, too, that are left out of ``record`` because they are dead.
    imaging : Imaging, optional
        The camera, for Strehl ratios; 2.2 um by default.
    progress : callable, optional
        Called with 1 after each of 4 steps.
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
    ('pure integrator', ['turbulence', 'measurement noise', 'all'])
    """
    require_instance(record, LoopRecord)
    step = progress or (lambda _: None)
    notes: list[str] = []
    commands = None
    if record.commands is not None:
        commands = explain_commands(record, sensor_gain=options.get("sensor_gain"))
        notes += commands.notes
    diagnosis = Diagnosis(
        record=record,
        imaging=Imaging() if imaging is None else imaging,
        commands=commands,
        channels=judge_channels(record if whole is None else whole),
    )
    step(1)
    if whole is not None and whole.axes > record.axes:
        notes.append("the rest is of the axis that lives: the other one is dead")
    if not diagnosis.doubt:
        diagnosis = _examine_loop(diagnosis, dict(given or {}), options, notes, step)
    elif given:
        notes.append("the given design was not tried: the commands are not right")
    return replace(diagnosis, notes=tuple(notes))


def _examine_loop(
    diagnosis: Diagnosis,
    given: dict[str, Design],
    options: dict[str, Any],
    notes: list[str],
    step: Callable[[int], object],
) -> Diagnosis:
    """Add what models of the record tell: of all of it, and of its first half on the second."""
    record = diagnosis.record

    def fit(**more: Any) -> IdentifiedModel:
        require_length(record)
        return identify(record, **options | more)

    model = _attempt(fit, "model", notes)
    step(1)
    if model is None:
        return diagnosis
    notes += model.notes
    controllers = {name: given_controller(design, model) for name, design in given.items()}
    running = running_controller(diagnosis.law, record.frame_rate_hz)
    facts = loop_facts(model, running)
    diagnosis = replace(diagnosis, model=model, loop=facts, lines=disturbance_lines(model))
    first, _ = split_halves(record.stretches(), record.frames)
    # one sensor gain for all that is said: a half shows it less well
    fixed = {"stretches": first, "start": model, "sensor_gain": list(model.sensor_gains)}
    half = _attempt(lambda: fit(**fixed), "model of the first half", notes)
    step(1)
    plant = (model if half is None else half).plant()
    if running is not None and not close_loop(plant.hardware, running).is_stable:
        notes.append("the law of the commands is unstable at the sensor gain of the model")
        running = None
    if half is not None:
        diagnosis = _compare(diagnosis, half, running, controllers, notes)
    best, imaging = diagnosis.best_design, diagnosis.imaging
    lines = disturbance_lines(model if half is None else half)
    chosen = None if best is None else best.controller
    costs = _attempt(
        lambda: disturbance_costs(plant, lines, running, chosen, imaging), "costs", notes
    )
    step(1)
    diagnosis = replace(diagnosis, costs=costs or ())
    for name, design in given.items():
        notes += design_differences(design, model)
        row = diagnosis.row(name)
        diagnosis = replace(diagnosis, given=given_design_facts(name, design, model, row))
    return diagnosis


def _compare(
    diagnosis: Diagnosis,
    half: IdentifiedModel,
    running: Controller | None,
    given: Mapping[str, Controller],
    notes: list[str],
) -> Diagnosis:
    """Add residuals on the second half, and the best design there for a model of the first."""
    plant = half.plant()
    with_bands = [m for m in METHODS.values() if m.plant_section is not None]
    methods = (*reference_methods(estimators_only=True), *with_bands)
    designs, missing = stable_designs(plant, {method.name: {} for method in methods})
    stable = {
        name: controller
        for name, controller in given.items()
        if close_loop(plant.hardware, controller).is_stable
    }
    unstable = given.keys() - stable.keys()
    notes += missing
    notes += [f"{name} is unstable in the loop of this record" for name in unstable]
    table = _attempt(
        lambda: compare_on_record(
            diagnosis.record,
            half,
            {**designs, **stable},
            running=running,
            imaging=diagnosis.imaging,
        ),
        "comparison on unseen data",
        notes,
    )
    if table is None:
        return diagnosis
    notes += table.notes
    designs[INTEGRATOR] = model_integrator(plant)  # the comparison has it
    residuals = {row.name: row.replayed.total_nm2 for row in table.entries if row.replayed}
    best = min(designs, key=lambda name: residuals[name])
    return replace(diagnosis, comparison=table, best=best, best_design=designs[best])


def _attempt(compute: Callable[[], Any], what: str, notes: list[str]) -> Any:
    """Return what is computed; None, and a note, where it cannot be."""
    try:
        return compute()
    except LbtSynthError as error:
        notes.append(f"no {what}: {error}")
        return None
