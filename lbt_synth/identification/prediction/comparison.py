"""Controllers compared on data that nothing was fitted to, beside what the model promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design, integrator
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification.accelerometers.readings import Channels
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.regression import noisier, regress
from lbt_synth.identification.prediction.residual import (
    ResidualEstimate,
    estimate_residual,
    gather,
    inverse_sensor,
    mode_noise,
    replay,
    settled_test,
)
from lbt_synth.identification.records.faults import SURPRISING
from lbt_synth.identification.records.record import LoopRecord, Stretches, split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, strehl
from lbt_synth.loop.budget import model_covariances
from lbt_synth.loop.least_residual import least_residual
from lbt_synth.methods.method import DesignInputs
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import design_request
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, frozen_copy, matrix, require_instance

RAN = "what ran"
INTEGRATOR = "best integrator"
LIMIT = "limit of performance"
WITHOUT = ", wavefront alone"  # of the fall-back of a design that reads accelerometers


@table_row
class PredictionRow:
    """One controller on frames that nothing was fitted to, beside what the model promises."""

    name: str = column("controller")
    # residual over all axes on the data, its standard error, and what the model promises
    replayed_nm: float = nm_column("data", format=".2f", key="data_nm")
    replayed_error_nm: float = nm_column("+-", format=".2f", key="data_error_nm")
    model_nm: float = nm_column("model", format=".2f")
    ratio: float = column("data/model", format=".3f")
    strehl: float = column("Strehl, data", format=".3f")
    model_strehl: float = column("Strehl, model", format=".3f")
    replayed: ResidualEstimate | None  # on the test data; None for the limit, no controller
    model_axis_nm: FloatArray | None  # (n,): promised for each axis; None if unknown

    @property
    def deviations(self) -> float:
        """Variance on the data less that of the model, in standard errors; nan if unknown."""
        if self.replayed is None:
            return np.nan
        error = self.replayed.total_error_nm2
        return (self.replayed.total_nm2 - self.model_nm**2) / error if error > 0 else np.nan

    @property
    def contradicts_model(self) -> bool:
        """Whether data and model are further apart than chance explains."""
        return bool(abs(self.deviations) > SURPRISING)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionTable:
    """What ran, controllers, and the limit, on the same data."""

    entries: tuple[PredictionRow, ...]
    # frames that controllers may be fitted to, and those that all rows are measured on: the halves
    # of the usable frames, without the first half second of a stretch
    fit: Stretches
    test: Stretches
    notes: tuple[str, ...]  # what is left out of the table or cannot be, and why

    def row(self, name: str) -> PredictionRow | None:
        """Return the row of a name, None where there is none."""
        return next((row for row in self.entries if row.name == name), None)

    def __getitem__(self, name: str) -> PredictionRow:
        """Return the row of a name; refuse one that there is none of."""
        if row := self.row(name):
            return row
        names = ", ".join(entry.name for entry in self.entries)
        raise ProblemError(f"the table has the rows {names}; got {name!r}.")


def prediction_against_data(
    record: LoopRecord,
    plant: TipTiltPlant,
    controllers: Mapping[str, Controller | Design],
    *,
    running: Controller | Design | None = None,
    noise_error_nm: ArrayLike = 0.0,
    imaging: Imaging | None = None,
    readings: ArrayLike | None = None,
) -> PredictionTable:
    """Replay controllers on frames that nothing was fitted to, and compare with the model.

    Other rows are what ran in a closed loop, by its own measurements, the best integrator by the
    model, and the least residual of any linear controller of the loop's own sensor if the model is
    true.

    Parameters
    ----------
    record : LoopRecord
        What the loop recorded. Its pseudo-open-loop series does not depend on what ran: from it,
        each controller computes exactly the commands that it would have given.
    plant : TipTiltPlant
        The model, with its sensor gain in the sensor matrix, which can be inverted. For an honest
        comparison it was not identified from the second half of the usable frames, the test.
    controllers : mapping of str to Controller or Design
        What is compared, by name; one whose loop is unstable is left out, with a note.
    running : Controller or Design, optional
        The controller that ran, if it is known, for what the model says of it.
    noise_error_nm : float or (q,) array_like, optional
        Standard error of the noise of each measurement, independent of each other [nm].
    imaging : Imaging, optional
        The camera, for Strehl ratios on at most two axes.
    readings : (frames, c) array_like, optional
        What accelerometers read in the frames of the record [m/s^2], for designs that read them;
        the model promises nothing of these.

    Returns
    -------
    PredictionTable
        Rows in this order: what ran, best integrator, controllers, limit. The standard errors are
        those of Gaussian series, and of the noise, not of the sensor gain.

    Raises
    ------
    ProblemError
        If sizes clash, a name is taken or a value is out of its range, or frames are too few.
    NumericalError
        If the limit does not settle.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=5.0, modes=1)
    >>> path, ran = plant.hardware, lbt.integrator(plant.hardware, gain=0.1)
    >>> night = lbt.simulate(
    ...     ran.controller, lbt.Truth(turbulence=slow, noise_nm=5.0), hardware=path, frames=8000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     night.measurements[0], night.commands[0], frame_rate_hz=800, delay_frames=2, unit="nm"
    ... )
    >>> table = lbt.identification.prediction_against_data(
    ...     record, plant, {"Kalman": lbt.kalman(plant)}
    ... )
    >>> [entry.name for entry in table.entries][::2]
    ['what ran', 'Kalman']
    >>> bool(abs(table["Kalman"].deviations) < 4)
    True
    """
    require_instance(record, LoopRecord)
    require_instance(plant, TipTiltPlant)
    if imaging is not None:
        require_instance(imaging, Imaging)
    plant.require_own_sensor("a replay of a record")
    hardware, runs = plant.hardware, record.stretches()
    if (hardware.modes, hardware.frame_rate_hz) != (record.axes, record.frame_rate_hz):
        raise ProblemError(
            f"plant and record must be of one loop; got {hardware.modes} modes at "
            f"{hardware.frame_rate_hz:.6g} Hz and {record.axes} axes at {record.frame_rate_hz:.6g}."
        )
    if {RAN, INTEGRATOR, LIMIT} & set(controllers):
        raise ProblemError(
            f"no controller may be called {RAN}, {INTEGRATOR} or {LIMIT}, as other rows are; got "
            f"{', '.join(controllers)}. Give other names."
        )
    fit, later = (frames.stretches() for frames in split_halves(record))
    test = settled_test(runs, later, hardware)
    noise = mode_noise(hardware, plant.R, noise_error_nm)
    designs = {INTEGRATOR: integrator(hardware, truth=plant), **controllers}
    if running is not None:
        designs[RAN] = running
    loops = {
        name: one.close(hardware) if isinstance(one, Design) else close_loop(hardware, one)
        for name, one in designs.items()
    }
    stable = {name: loop for name, loop in loops.items() if loop.is_stable}
    unstable = loops.keys() - stable.keys()
    notes = [f"{name} is unstable at the sensor gain of the model" for name in sorted(unstable)]
    beside = None if readings is None else matrix(readings, "readings")
    seen = record.measurements @ inverse_sensor(hardware).T
    series = seen + record.corrections() @ hardware.influence.T
    measured = {n: replay(loop, series, runs, beside) for n, loop in stable.items() if n != RAN}
    if record.commands is not None:
        measured = {RAN: seen, **measured}
    elif running is not None:
        raise ProblemError("what ran needs commands; got the record of an open loop.")
    rows = []
    for name, residual in measured.items():
        estimate = estimate_residual(gather(residual, test), test, *noise)
        promised = None
        if name in stable and not stable[name].reads_others:  # in means over frames, as records are
            covariances = model_covariances(stable[name], plant)  # at each phase
            promised = covariances[:, : record.axes, : record.axes].mean(axis=0)
        rows.append(_build_row(name, estimate, promised, imaging))
    if refuted := [row.name for row in rows if row.replayed and row.replayed.refuted]:
        notes.append(
            f"no residual on the data of {', '.join(refuted)}: its variance is more than "
            f"{SURPRISING:g} standard errors below zero; the model has more noise than the data, "
            "or another sensor gain. Identify the noise again."
        )
    try:
        limit = least_residual(plant.hardware, plant, frame_means=True)
    except ProblemError as error:  # modes that do not decouple, or a mirror without a limit
        notes.append(f"no {LIMIT}: {error}")
    else:
        along = limit.directions.T * limit.variance_nm2 @ limit.directions
        rows.append(_build_row(LIMIT, None, along, imaging))
    return PredictionTable(entries=tuple(rows), fit=fit, test=test, notes=tuple(notes))


def design_inputs(
    record: LoopRecord,
    model: IdentifiedModel,
    *,
    channels: Channels | None = None,
    added_nm: FloatArray | float = 0.0,
    penalty: float | None = None,
    separate: bool = False,
) -> DesignInputs:
    """Return what a method makes a design of: a model with more noise, its record and channels."""
    beside: dict[str, Any] = {"channels": channels, "added_nm": added_nm, "separate": separate}
    return DesignInputs(
        plant=noisier(model, added_nm).plant(),
        predict=lambda: regress(record, model, **beside).design(penalty),
    )


def compare_designs(
    record: LoopRecord,
    half: IdentifiedModel,
    methods: Mapping[str, Mapping[str, Any]],
    *,
    others: Mapping[str, Controller] | None = None,
    running: Controller | None = None,
    imaging: Imaging | None = None,
    **inputs: Any,
) -> tuple[PredictionTable, dict[str, Design]]:
    """Return what designs for a model of the first half of a record leave of the second.

    ``methods`` are options by the names of methods, ``others`` further controllers by theirs, and
    ``inputs`` those of :func:`design_inputs`. The designs with a row are returned by their titles;
    the others have a note. One that reads channels has a row for its fall-back, too.
    """
    made_of = design_inputs(split_halves(record)[0], half, **inputs)
    designs, notes = dict[str, Design](), list[str]()
    controllers = dict[str, Controller | Design](others or {})
    for method, options in methods.items():
        title = method_named(method).title
        try:
            design = design_request(method, options).build(made_of)
        except LbtSynthError as error:
            notes.append(f"no {title}: {str(error).rstrip('.')}")
            continue
        designs[title] = controllers[title] = design
        if design.other_sensors:
            *_, alone = design.controllers.values()
            q = half.hardware.n_measurements
            alone = replace(alone, B=alone.B[:, :q], D=alone.D[:, :q])
            controllers[f"{title}{WITHOUT}"] = alone
    channels: Channels | None = inputs.get("channels")
    table = prediction_against_data(
        record,
        half.plant(),
        controllers,
        running=running,
        noise_error_nm=[axis.noise_error_nm for axis in half.axes],
        imaging=imaging,
        readings=None if channels is None else channels.values,
    )
    rows = {row.name for row in table.entries}
    return (
        replace(table, notes=(*notes, *table.notes)),
        {title: design for title, design in designs.items() if title in rows},
    )


def _build_row(
    name: str,
    replayed: ResidualEstimate | None,
    promised: FloatArray | None,
    imaging: Imaging | None,
) -> PredictionRow:
    """Return a row of a residual on the data and a covariance (n, n) that the model promises."""
    data_nm = error_nm = model_nm = replayed_strehl = model_strehl = np.nan
    if replayed is not None:
        data_nm, error_nm = replayed.rms_nm, replayed.rms_error_nm
        replayed_strehl = np.nan if imaging is None else replayed.strehl(imaging)
    if promised is not None:
        model_nm = float(np.sqrt(np.trace(promised)))
        model_strehl = np.nan if imaging is None else strehl(promised, imaging)
    return PredictionRow(
        name=name,
        replayed_nm=data_nm,
        replayed_error_nm=error_nm,
        model_nm=model_nm,
        ratio=data_nm / model_nm if model_nm > 0 else np.nan,
        strehl=replayed_strehl,
        model_strehl=model_strehl,
        replayed=replayed,
        model_axis_nm=None if promised is None else frozen_copy(np.sqrt(np.diag(promised))),
    )
