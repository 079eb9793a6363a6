"""Controllers compared on data that nothing was fitted to, beside what the model promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification.accelerometers.readings import Channels
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.regression import regress
from lbt_synth.identification.prediction.residual import (
    ResidualEstimate,
    check_series,
    estimate_residual,
    gather,
    inverse_sensor,
    mode_noise,
    replay,
    settled_test,
)
from lbt_synth.identification.records.faults import SURPRISING
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches, StretchesLike, split_halves
from lbt_synth.linear import Controller
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import (
    ClosedLoop,
    Imaging,
    close_loop,
    residual_budget,
    strehl,
)
from lbt_synth.loop.least_residual import least_residual
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, frozen_copy, matrix, require_instance

RAN = "what ran"
INTEGRATOR = "best integrator"
LIMIT = "limit of performance"


@table_row
class PredictionRow:
    """One controller on frames that nothing was fitted to, beside what the model promises."""

    name: str = column("controller", help="What it is")
    replayed_nm: float = nm_column(
        "data", format=".2f", key="data_nm", help="Residual on the data, all axes"
    )
    replayed_error_nm: float = nm_column(
        "+-", format=".2f", key="data_error_nm", help="Its standard error"
    )
    model_nm: float = nm_column("model", format=".2f", help="Residual that the model promises")
    ratio: float = column("data/model", format=".3f", help="Residual on the data over that")
    strehl: float = column("Strehl, data", format=".3f", help="Strehl ratio on the data")
    model_strehl: float = column("Strehl, model", format=".3f", help="Strehl ratio by the model")
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
    """What ran, controllers, and the limit, on the same data.

    Attributes
    ----------
    entries : tuple of PredictionRow
        The rows.
    fit, test : tuple of (start, stop)
        Frames that controllers may be fitted to, and those that all rows are measured on: the
        halves of the usable frames, without the first half second of a stretch.
    notes : tuple of str
        What is left out of the table or cannot be, and why.
    """

    entries: tuple[PredictionRow, ...]
    fit: Stretches
    test: Stretches
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> PredictionRow:
        """Return the row of a name."""
        for entry in self.entries:
            if entry.name == name:
                return entry
        names = ", ".join(entry.name for entry in self.entries)
        raise ProblemError(f"the table has the rows {names}; got {name!r}.")


def prediction_against_data(
    plant: TipTiltPlant,
    open_loop: ArrayLike,
    controllers: Mapping[str, Controller | Design],
    *,
    stretches: StretchesLike | None = None,
    measurements: ArrayLike | None = None,
    running: Controller | Design | None = None,
    noise_error_nm: ArrayLike = 0.0,
    imaging: Imaging | None = None,
    readings: ArrayLike | None = None,
) -> PredictionTable:
    """Replay controllers on frames that nothing was fitted to, and compare with the model.

    Other rows are the best integrator by the model, and the least residual of any linear controller
    of the loop's own sensor if the model is true.

    Parameters
    ----------
    plant : TipTiltPlant
        The model, with its sensor gain in the sensor matrix. For an honest comparison it was not
        identified from the frames of the test.
    open_loop, stretches, noise_error_nm
        As for :func:`replayed_residual`; the halves of :func:`split_halves` are to fit and to test.
    controllers : mapping of str to Controller or Design
        What is compared, by name; one whose loop is unstable is left out, with a note.
    measurements : (frames, q) array_like, optional
        Measurements y(k) of the loop that ran, for its own row [nm].
    running : Controller or Design, optional
        The controller that ran, if it is known, for what the model says of it.
    imaging : Imaging, optional
        The camera, for Strehl ratios on at most two axes.
    readings : (frames, c) array_like, optional
        What accelerometers read in the frames of open_loop [m/s^2], for designs that read them; the
        model promises nothing of these.

    Returns
    -------
    PredictionTable
        Rows in this order: what ran, best integrator, controllers, limit.

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
    >>> y, u = night.measurements[0], night.commands[0]
    >>> table = lbt.identification.prediction_against_data(
    ...     plant, y[2:] + u[:-2], {"Kalman": lbt.kalman(plant)}, measurements=y[2:]
    ... )
    >>> [entry.name for entry in table.entries][::2]
    ['what ran', 'Kalman']
    >>> bool(abs(table["Kalman"].deviations) < 4)
    True
    """
    require_instance(plant, TipTiltPlant)
    if imaging is not None:
        require_instance(imaging, Imaging)
    hardware = plant.hardware
    series, runs = check_series(open_loop, hardware.modes, stretches)
    fit, later = split_halves(runs, len(series))
    test = settled_test(runs, later, hardware)
    noise = mode_noise(hardware, plant.R, noise_error_nm)
    designs = {INTEGRATOR: model_integrator(plant), **controllers}
    if {RAN, INTEGRATOR, LIMIT} & set(controllers):
        raise ProblemError(
            f"no controller may be called {RAN}, {INTEGRATOR} or {LIMIT}, as other rows are; got "
            f"{', '.join(controllers)}. Give other names."
        )
    if running is not None:
        designs[RAN] = running
    loops = {name: _close(hardware, design) for name, design in designs.items()}
    stable = {name: loop for name, loop in loops.items() if loop.is_stable}
    unstable = loops.keys() - stable.keys()
    notes = [f"{name} is unstable at the sensor gain of the model" for name in sorted(unstable)]
    beside = None if readings is None else matrix(readings, "readings")
    measured = {n: replay(loop, series, runs, beside) for n, loop in stable.items() if n != RAN}
    if measurements is not None:
        y, _ = check_series(measurements, hardware.n_measurements, test, "measurements")
        if len(y) != len(series):
            frames = f"the {len(series)} frames of open_loop"
            raise ProblemError(f"measurements must have {frames}; got {len(y)}.")
        measured = {RAN: y @ inverse_sensor(hardware).T, **measured}
    elif running is not None:
        raise ProblemError("the controller that ran needs its measurements; got none.")
    rows = []
    for name, residual in measured.items():
        estimate = estimate_residual(gather(residual, test), test, *noise)
        promised = None
        if name in stable and not stable[name].reads_others:  # in means over frames, as records are
            promised = residual_budget(stable[name], plant, frame_means=True).total_nm2
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


def _close(hardware: LoopHardware, design: Controller | Design) -> ClosedLoop:
    """Close the loop of a model around a controller, or a design with the sensors it reads."""
    if isinstance(design, Design):
        return design.close(hardware)
    return close_loop(hardware, as_controller(design))


def compare_designs(
    record: LoopRecord,
    half: IdentifiedModel,
    requests: Mapping[str, Mapping[str, Any]],
    *,
    defaults: Mapping[str, Any] | None = None,
    others: Mapping[str, Controller] | None = None,
    running: Controller | None = None,
    imaging: Imaging | None = None,
    channels: Channels | None = None,
) -> tuple[PredictionTable, dict[str, Design]]:
    """Return what designs for a model of the first half of a record leave of the second.

    ``requests`` are the options of methods by their names, and ``others`` further controllers by
    theirs. The designs with a row are returned by their titles; the others have a note. A predictor
    reads the channels beside the record, too.
    """

    def predict() -> Design:
        first, _ = split_halves(record.stretches(), record.frames)
        return regress(record, half, stretches=first, channels=channels).design()

    inputs = PlantInputs(plant=half.plant(), design_defaults=defaults or {}, predict=predict)
    designs, notes = dict[str, Design](), list[str]()
    for method, options in requests.items():
        title = method_named(method).title
        try:
            designs[title] = design_request(method, options).build(inputs)
        except LbtSynthError as error:
            notes.append(f"no {title}: {str(error).rstrip('.')}")
    table = prediction_against_data(
        inputs.plant,
        record.pseudo_open_loop(half.sensor_gains),
        {**designs, **(others or {})},
        stretches=record.stretches(),
        measurements=None if record.commands is None else record.measurements,
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


def unseen_claims(
    record: LoopRecord, half: IdentifiedModel, design: Design, channels: Channels | None
) -> dict[str, float]:
    """Return what a predictor of the first half of a record claims of the second [nm rms].

    A residual that the noise hides is not claimed.
    """
    series = record.pseudo_open_loop(half.sensor_gains)
    runs = record.stretches()
    test = settled_test(runs, split_halves(runs, len(series))[1], half.hardware)
    noise = mode_noise(half.hardware, half.plant().R, [a.noise_error_nm for a in half.axes])
    names, claims = iter(("residual_nm", "alone_nm")), dict[str, float]()
    for controller in design.controllers.values():
        loop = close_loop(design.hardware or half.hardware, controller)
        residual = replay(loop, series, runs, None if channels is None else channels.values)
        estimate = estimate_residual(gather(residual, test), test, *noise)
        name = next(names)
        if estimate.total_nm2 > 0:
            claims[name] = estimate.rms_nm
            claims.setdefault("residual_error_nm", estimate.rms_error_nm)
    return claims


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
