"""The autopsy of a record: all that it tells of its loop, in rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification.commands.control_law import ControlLaw, law_controller
from lbt_synth.identification.commands.verdict import CommandVerdict, explain_commands
from lbt_synth.identification.diagnosis.rows import (
    ChannelRow,
    CostRow,
    disturbance_costs,
    disturbance_lines,
    given_controller,
    given_design_notes,
    judge_channels,
    loop_facts,
)
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.comparison import (
    INTEGRATOR,
    PredictionRow,
    PredictionTable,
    compare_designs,
)
from lbt_synth.identification.prediction.residual import ResidualEstimate
from lbt_synth.identification.records.record import LoopRecord, require_length
from lbt_synth.identification.stretches import split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging
from lbt_synth.methods.registry import all_methods, reference_methods
from lbt_synth.storage.rows import Facts
from lbt_synth.validation import require_instance

T = TypeVar("T")


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
    comparison : PredictionTable or None
        Residuals on the second half of the record, by models of the first.
    best : str
        Row of the comparison that leaves least, of the designs.
    best_design : Design or None
        The same design, for the model of the first half.
    costs : tuple of CostRow
        What each part of the disturbance costs by the model of the first half (of the whole record
        where there is no comparison), the most costly first; the last row is all.
    notes : tuple of str
        What could not be said and why, and what else should be known.
    """

    record: LoopRecord
    imaging: Imaging
    commands: CommandVerdict | None = None
    channels: tuple[ChannelRow, ...] = ()
    model: IdentifiedModel | None = None
    loop: Facts | None = None
    comparison: PredictionTable | None = None
    best: str = ""
    best_design: Design | None = None
    costs: tuple[CostRow, ...] = ()
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
        Designs to try on the record, by their names.
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
    step, designs, notes = progress or (lambda _: None), dict(given or {}), list[str]()
    commands = None
    if record.commands is not None:
        commands = explain_commands(record, sensor_gain=options.get("sensor_gain"))
        notes += commands.notes
    diagnosis = Diagnosis(
        record=record,
        imaging=imaging or Imaging(),
        commands=commands,
        channels=judge_channels(record if whole is None else whole),
    )
    step(1)
    if whole is not None and whole.axes > record.axes:
        notes.append("the rest is of the axis that lives: the other one is dead")
    if diagnosis.doubt:
        notes += ["the given design was not tried: the commands are not right"] * bool(designs)
        return replace(diagnosis, notes=tuple(notes))

    def fit(**more: Any) -> IdentifiedModel:
        require_length(record)
        return identify(record, **options | more)

    model = _attempt(fit, "model", notes)
    step(1)
    if model is not None:
        notes += model.notes
        diagnosis = replace(diagnosis, model=model)
        first, _ = split_halves(record.stretches(), record.frames)
        # one sensor gain for all that is said: a half shows it less well
        fixed = {"stretches": first, "start": model, "sensor_gain": list(model.sensor_gains)}
        half = _attempt(lambda: fit(**fixed), "model of the first half", notes)
        step(1)
        diagnosis = _examine_loop(diagnosis, model, half, designs, notes)
        step(1)
    return replace(diagnosis, notes=tuple(notes))


def _examine_loop(
    diagnosis: Diagnosis,
    model: IdentifiedModel,
    half: IdentifiedModel | None,
    given: Mapping[str, Design],
    notes: list[str],
) -> Diagnosis:
    """Add what models tell: of all of the record, and of its first half on the second."""
    law, running = diagnosis.law, None
    if law is not None and law.is_sure and law.lag_frames >= 0:
        running = law_controller(law, model.frame_rate_hz)
    controllers = {name: given_controller(design, model) for name, design in given.items()}
    diagnosis = replace(diagnosis, loop=loop_facts(model, running))
    if half is not None:
        diagnosis = _compare(diagnosis, half, running, controllers, notes)
    best = None if diagnosis.best_design is None else diagnosis.best_design.controller
    basis = model if half is None else half

    def compute_costs() -> tuple[CostRow, ...]:
        lines = disturbance_lines(basis)
        return disturbance_costs(basis.plant(), lines, running, best, diagnosis.imaging)

    diagnosis = replace(diagnosis, costs=_attempt(compute_costs, "costs", notes) or ())
    for name, design in given.items():
        notes += given_design_notes(name, design, model)
    return diagnosis


def _compare(
    diagnosis: Diagnosis,
    half: IdentifiedModel,
    running: Controller | None,
    given: Mapping[str, Controller],
    notes: list[str],
) -> Diagnosis:
    """Add residuals on the second half, and the best design there for a model of the first."""
    robust = [m for m in all_methods().values() if m.plant_section is not None]
    methods = [*reference_methods(estimators_only=True), *robust]
    compared = _attempt(
        lambda: compare_designs(
            diagnosis.record,
            half,
            {method.name: {} for method in methods},
            others=given,
            running=running,
            imaging=diagnosis.imaging,
        ),
        "comparison on unseen data",
        notes,
    )
    if compared is None:
        return diagnosis
    table, designs = compared
    notes += table.notes
    designs = designs | {INTEGRATOR: model_integrator(half.plant())}  # the comparison has it
    residuals = {row.name: row.replayed.total_nm2 for row in table.entries if row.replayed}
    best = min(designs, key=lambda name: residuals[name])
    return replace(diagnosis, comparison=table, best=best, best_design=designs[best])


def _attempt(compute: Callable[[], T], what: str, notes: list[str]) -> T | None:
    """Return what is computed; None, and a note, where it cannot be."""
    try:
        return compute()
    except LbtSynthError as error:
        notes.append(f"no {what}: {error}")
        return None
