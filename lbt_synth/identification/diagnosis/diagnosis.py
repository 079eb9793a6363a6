"""The autopsy of a record: all that it tells of its loop, in rows and sentences.

The verdict on a record: its state, what the residual is made of, and what to change first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.verdict import CommandVerdict, explain_commands
from lbt_synth.identification.diagnosis.line_origins import (
    CostRow,
    LineRow,
    disturbance_costs,
    line_origins,
)
from lbt_synth.identification.diagnosis.running_loop import (
    ChannelRow,
    design_differences,
    given_controller,
    given_design_facts,
    judge_channels,
    loop_facts,
    running_controller,
)
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.comparison import (
    INTEGRATOR,
    RAN,
    PredictionRow,
    PredictionTable,
    prediction_against_data,
)
from lbt_synth.identification.records.record import LoopRecord, require_length
from lbt_synth.identification.stretches import split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual, limit_or_nan
from lbt_synth.methods.registry import all_methods, reference_methods
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import require_instance

NARROW = 0.3  # modulus margin
_GOOD_ENOUGH = 1.03  # times the least residual, that no change is worth
_BY_CHANCE = 1.25  # times the least residual, at most, that the errors may excuse
_SIGMAS = 2.0
_NEARLY = 1.15  # times the least residual, that a better gain alone may leave
_MOST_LOST = 0.02  # of the frames
_DELAY_WARNING = "warning: a delay of"
_PARTS = 3  # of the disturbance that are named
_LEAST_PART = 0.05  # of the residual variance, of a part that is named


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
    lines : tuple of LineRow
        Vibrations, and where they come from.
    comparison : PredictionTable or None
        Residuals on the second half of the record, by models of the first.
    best : str
        Row of the comparison that leaves least, of the designs.
    best_design : Design or None
        The same design, for the model of the first half.
    costs : tuple of CostRow
        What each part of the disturbance costs by the model of the first half (of the whole record
        where there is no comparison), the most costly first; the last row is all.
    limit_nm : float
        Residual below which no linear controller comes, by the same model [nm rms]; nan where it is
        not known.
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
    lines: tuple[LineRow, ...] = ()
    comparison: PredictionTable | None = None
    best: str = ""
    best_design: Design | None = None
    costs: tuple[CostRow, ...] = ()
    limit_nm: float = float("nan")
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
    >>> found = lbt.identification.diagnose(record)
    >>> found.law.kind, [row.part for row in found.costs]
    ('pure integrator', ['turbulence', 'measurement noise', 'all'])
    """
    require_instance(record, LoopRecord)
    step = progress or (lambda _: None)
    notes: list[str] = []
    commands = None
    if record.commands is not None:
        commands = explain_commands(record, sensor_gain=options.get("sensor_gain"))
        notes += commands.notes
    found = Diagnosis(
        record=record,
        imaging=Imaging() if imaging is None else imaging,
        commands=commands,
        channels=judge_channels(record if whole is None else whole),
    )
    step(1)
    if whole is not None and whole.axes > record.axes:
        notes.append("the rest is of the axis that lives: the other one is dead")
    if not found.doubt:
        found = _examine_loop(found, dict(given or {}), options, notes, step)
    elif given:
        notes.append("the given design was not tried: the commands are not right")
    return replace(found, notes=tuple(notes))


def _examine_loop(
    found: Diagnosis,
    given: dict[str, Design],
    options: dict[str, Any],
    notes: list[str],
    step: Callable[[int], object],
) -> Diagnosis:
    """Add what models of the record tell: of all of it, and of its first half on the second."""
    record = found.record
    model = _attempt(lambda: _identify(record, options), "model", notes)
    step(1)
    if model is None:
        return found
    notes += model.notes
    running = running_controller(found.law, record.frame_rate_hz)
    lines = line_origins(model)
    found = replace(found, model=model, loop=loop_facts(model, running), lines=lines)
    controllers = {name: given_controller(design, model) for name, design in given.items()}
    compared = _attempt(
        lambda: _compare(found, running, controllers, options, notes, step),
        "comparison on unseen data",
        notes,
    )
    if compared is not None:
        found, model, lines = compared
    design, plant = found.best_design, model.plant()
    costs = _attempt(
        lambda: disturbance_costs(
            plant, lines, running, None if design is None else design.controller, found.imaging
        ),
        "costs",
        notes,
    )
    limit_nm = limit_or_nan(lambda: least_model_residual(plant, frame_means=True))
    step(1)
    found = replace(found, costs=costs or (), limit_nm=limit_nm)
    for name, design in given.items():
        assert found.model is not None
        notes += design_differences(design, found.model)
        facts = given_design_facts(name, design, found.model, found.row(name))
        found = replace(found, given=facts)
    return found


def _identify(record: LoopRecord, options: dict[str, Any]) -> IdentifiedModel:
    require_length(record)
    return identify(record, **options)


def _compare(
    found: Diagnosis,
    running: Controller | None,
    given: Mapping[str, Controller],
    options: dict[str, Any],
    notes: list[str],
    step: Callable[[int], object],
) -> tuple[Diagnosis, IdentifiedModel, tuple[LineRow, ...]]:
    """Add residuals on the second half and the best design there, by a model of the first half.

    Return it, the model and its lines.
    """
    record = found.record
    fit, test = split_halves(record.stretches(), record.frames)
    half = identify(record, stretches=fit, start=found.model, **options)
    step(1)
    plant, series = half.plant(), record.pseudo_open_loop(half.sensor_gains)
    designs = _stable_designs(plant, notes)
    stable = {}
    for name, controller in given.items():
        if close_loop(plant.hardware, controller).is_stable:
            stable[name] = controller
        else:
            notes.append(f"{name} is unstable in the loop of this record")
    if running is not None and not close_loop(plant.hardware, running).is_stable:
        notes.append("the law of the commands is unstable at the sensor gain of the model")
        running = None
    table = prediction_against_data(
        plant,
        series,
        {**designs, **stable},
        fit=fit,
        test=test,
        measurements=None if record.commands is None else record.measurements,
        running=running,
        noise_error_nm=[axis.noise_error_nm for axis in half.axes],
        imaging=found.imaging,
    )
    notes += table.notes
    designs[INTEGRATOR] = model_integrator(plant)  # the comparison has it
    left = {
        entry.name: entry.replayed.total_nm2
        for entry in table.entries
        if entry.replayed is not None and entry.name in designs
    }
    best = min(left, key=lambda name: left[name])
    found = replace(found, comparison=table, best=best, best_design=designs[best])
    return found, half, line_origins(half)


def _stable_designs(plant: TipTiltPlant, notes: list[str]) -> dict[str, Design]:
    """Return the designs that hold a plant's loop by their titles; note why others are missing."""
    inputs, designs = PlantInputs(plant=plant), {}
    with_bands = [each for each in all_methods().values() if each.plant_section is not None]
    for method in (*reference_methods(estimators_only=True), *with_bands):
        try:
            design = design_request(method.name, {}).build(inputs)
        except LbtSynthError as error:
            notes.append(f"no {method.title}: {error}")
            continue
        if close_loop(plant.hardware, design.controller).is_stable:
            designs[method.title] = design
        else:
            notes.append(f"no {method.title}: its loop is not stable at the identified sensor gain")
    return designs


def _attempt(compute: Callable[[], Any], what: str, notes: list[str]) -> Any:
    """Return what is computed; None, and a note, where it cannot be."""
    try:
        return compute()
    except LbtSynthError as error:
        notes.append(f"no {what}: {error}")
        return None


def diagnosis_verdict(found: Diagnosis) -> tuple[str, str, str]:
    """Return three sentences: the record, what its residual is made of, what to change first."""
    return _state_sentence(found), _residual_sentence(found), _advice_sentence(found)


def _state_sentence(found: Diagnosis) -> str:
    """Say whether the record can be used, and what ran."""
    faults = "; ".join(_faults(found))
    if found.doubt:
        other = f" The record has faults, too: {faults}." if faults else ""
        return f"The commands are not those that the mirror followed: {found.doubt}.{other}"
    if faults:
        return f"The record has faults: {faults}."
    delays = [note for note in found.notes if note.startswith(_DELAY_WARNING)]
    if delays:
        return f"The delay of the record is doubtful: {delays[0].removeprefix('warning: ')}."
    law = "an open loop ran"
    if found.law is not None:
        law = f"{found.law.name} ran{found.law.lag_text}"
    if found.model is None or found.loop is None:
        return f"The record shows no fault, and {law}."
    gain = f"at the sensor gain of {found.loop.sensor_gain}"
    if found.loop.spectral_radius >= 1:
        return f"The record shows no fault, but {law}, which is UNSTABLE {gain}."
    stable = f", stable {gain}" if found.loop.stable_gains else ""
    if found.loop.modulus < NARROW:
        stable += f" but with a modulus margin of {found.loop.modulus:.2g} only"
    return f"The record is sound: {law}{stable}."


def _faults(found: Diagnosis) -> list[str]:
    """Say which channels are at fault, and how many frames are lost."""
    out = [f"the {row.channel} is {row.state}" for row in found.channels if row.serious]
    if found.record.lost > _MOST_LOST:
        out.append(f"{100 * found.record.lost:.2g} % of the frames are lost")
    return out


def _residual_sentence(found: Diagnosis) -> str:
    """Say what the loop that ran leaves, and of what."""
    ran = found.row(RAN)
    parts = found.costs[:-1]
    if not parts:
        return "Nothing can be said of its residual."
    total = found.costs[-1]
    by_running = np.isfinite(total.running_nm)
    whole = total.running_nm if by_running else total.best_nm
    named = []
    for row in parts[:_PARTS]:
        nm = row.running_nm if by_running else row.best_nm
        if nm**2 >= _LEAST_PART * whole**2:
            named.append(f"{nm_text(nm)} of the {row.part}{row.where}")
    if not by_running:
        return f"By the model the {found.best} would leave {nm_text(whole)}: {listing_text(named)}."
    measured = doubt = ""
    if ran is not None and np.isfinite(ran.replayed_nm):
        measured = (
            f"It leaves {nm_text(ran.replayed_nm, error_nm=ran.replayed_error_nm)} on unseen data "
            f"(Strehl ratio {ran.strehl:.3f}), by the model "
        )
        doubt = ", which the data contradict" * ran.contradicts_model
    return f"{measured or 'By the model it leaves '}{nm_text(whole)}{doubt}: {listing_text(named)}."


def _advice_sentence(found: Diagnosis) -> str:
    """Say what to change first."""
    bad = next((row for row in found.channels if row.serious), None)
    if bad is not None:
        return f"First look at the {bad.channel}, which is {bad.state}."
    if found.doubt and found.commands is not None:
        return f"First {found.commands.advice}."
    if any(note.startswith(_DELAY_WARNING) for note in found.notes):
        return "First check the delay, on which sensor gain and designs depend."
    ran, best, slow = found.row(RAN), found.row(found.best), found.row(INTEGRATOR)
    if best is None or best.replayed is None:
        return "Record longer before anything is changed."
    bound = ""
    if np.isfinite(found.limit_nm):
        bound = f"; by the model no linear controller leaves less than {nm_text(found.limit_nm)}"
    leaves = f"{nm_text(best.replayed_nm, error_nm=best.replayed_error_nm)}"
    if ran is None or ran.replayed is None:
        return f"The {found.best} leaves least, {leaves} (Strehl ratio {best.strehl:.3f}{bound})."
    difference, error = ran.replayed.above(best.replayed)
    ratio = ran.replayed_nm / best.replayed_nm
    if ratio < _GOOD_ENOUGH or (difference < _SIGMAS * error and ratio < _BY_CHANCE):
        return f"Change nothing: the {found.best} would leave {leaves}{bound}."
    slow_nm = np.nan if slow is None else slow.replayed_nm
    if slow_nm < _NEARLY * best.replayed_nm:
        other = "" if found.best == INTEGRATOR else f", the {found.best} {leaves}"
        return (
            f"First change the gain{_gain_text(found)}: the {INTEGRATOR} leaves {nm_text(slow_nm)} "
            f"on unseen data{other}{bound}."
        )
    return (
        f"First change the controller: the {found.best} leaves {leaves} on unseen data (Strehl "
        f"ratio {best.strehl:.3f}), the {INTEGRATOR} {nm_text(slow_nm)}{bound}."
    )


def _gain_text(found: Diagnosis) -> str:
    """Say from which gain to which, where an integrator ran."""
    law = found.law
    if law is None or law.order != 1 or found.model is None:
        return ""
    design = model_integrator(found.model.plant())
    best = float(np.mean(np.diag(design.controller.B)))
    return f" from {float(np.mean(np.diag(law.gain))):.3g} to {best:.3g}"
