"""Controllers compared on data that nothing was fitted to, beside what the model promises.

One of them is the best FIR predictor of a record by least squares, without a model of the
disturbance. With the mirror's taps c, the filtered series ``zf(k) = c[0] z(k) + c[1] z(k-1) + ...``
and commands ``u(k) = a[0] z(k) + a[1] z(k-1) + ...``, the measured residual is ``e(k) = z(k) - a[0]
zf(k-1) - a[1] zf(k-2) - ...``: a linear regression whose sum of squares is the one that a replay
measures, for fractional delays and mirrors that move as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError, ProblemError, UnstableLoopError
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.residual import (
    ResidualEstimate,
    check_series,
    estimate_residual,
    gather,
    inverse_sensor,
    invert,
    mode_noise,
    replay,
    settled_test,
)
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches, StretchesLike, split_halves
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.loop import (
    ClosedLoop,
    Imaging,
    close_loop,
    jitter_strehl,
    residual_budget,
)
from lbt_synth.loop.closed_loop import youla_controller
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, frozen_copy, integer, require_instance

RAN = "what ran"
INTEGRATOR = "best integrator"
PREDICTOR = "least-squares predictor"
LIMIT = "limit of performance"
_RESERVED = (RAN, INTEGRATOR, PREDICTOR, LIMIT)
_MOST_TAPS = 1000
_LEAST_ROWS = 4  # frames per coefficient
_MOST_DEVIATIONS = 4.0  # standard errors between data and model that chance explains


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
        return bool(abs(self.deviations) > _MOST_DEVIATIONS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionTable:
    """What ran, controllers, a predictor without a model, and the limit, on the same data.

    Attributes
    ----------
    entries : tuple of PredictionRow
        The rows.
    fit, test : tuple of (start, stop)
        Frames that the predictor was fitted to, and those that all rows are measured on: the
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
        raise ProblemError(
            f"the table has the rows {', '.join(entry.name for entry in self.entries)}; got "
            f"{name!r}."
        )


def least_squares_predictor(
    open_loop: ArrayLike,
    hardware: LoopHardware,
    *,
    taps: int = 32,
    stretches: StretchesLike | None = None,
) -> tuple[Controller, FloatArray]:
    """Fit the FIR predictor of least residual of each mode to a record, and make it a controller.

    Parameters
    ----------
    open_loop : (frames, n) array_like
        Recorded pseudo-open-loop series ``z(k) = phi_tot(k-1) + S^-1 w(k)`` [nm].
    hardware : LoopHardware
        The loop: delay, mirror, sensor and influence matrix, both square and invertible. The sensor
        matrix has the sensor gain that z was formed with.
    taps : int, optional
        Coefficients per mode, at most 1000.
    stretches : sequence of (start, stop), optional
        Contiguous usable frames to fit; by default the whole record.

    Returns
    -------
    controller : Controller
        From y(k) to u(k). The filter is its Youla parameter (:func:`youla_controller`): the loop
        is stable for any coefficients, at the sensor gain of the fit.
    coefficients : (n, taps) ndarray
        What z_i(k-l) adds to the correction of mode i that u(k) commands. Regressors that depend
        on each other get the coefficients of least norm.

    Raises
    ------
    ProblemError
        If a value is out of range, sizes clash, or there are fewer than four frames per
        coefficient.

    Examples
    --------
    Two frames ahead, an AR1 process without noise is predicted by the square of its pole:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> idle = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=1 / 800)
    >>> run = lbt.simulate(idle, lbt.Truth(turbulence=slow), hardware=path, frames=20_000)
    >>> _, taps = lbt.identification.least_squares_predictor(run.total_nm[0], path, taps=1)
    >>> bool(abs(taps[0, 0] - 0.81) < 0.02)
    True
    """
    require_instance(hardware, LoopHardware)
    count = integer(taps, "taps", at_least=1, at_most=_MOST_TAPS)
    back, n = inverse_sensor(hardware), hardware.modes
    need = "a predictor needs a command for every mode, and an influence matrix"
    to_command = invert(hardware.influence, need)
    series, parts = check_series(open_loop, n, stretches)
    blocks = [_regression(series[a:b], hardware.mirror_taps, count) for a, b in parts]
    X, Z = (np.concatenate(block) for block in zip(*blocks, strict=True))
    if len(X) < _LEAST_ROWS * count:
        raise ProblemError(
            f"a predictor of {count} coefficients needs at least {_LEAST_ROWS * count} frames to "
            f"fit, beside {count} and the mirror's at the beginning of each stretch; got "
            f"{len(X)}. Record more, or lower taps."
        )
    tolerance = np.finfo(float).eps * (count + 1)
    fits = [np.linalg.lstsq(X[:, i], Z[:, i], rcond=tolerance)[0] for i in range(n)]
    coefficients = np.array(fits)
    # an FIR filter of z from y to u, whose states are the last z
    parameter = Controller(
        A=np.eye(n * count, k=-n),
        B=np.vstack([back, np.zeros((n * (count - 1), n))]),
        C=to_command @ np.hstack([np.diag(column) for column in coefficients.T]),
        D=np.zeros((n, n)),
        dt_s=hardware.dt_s,
    )
    return youla_controller(hardware, parameter), frozen_copy(coefficients)


def _regression(
    part: FloatArray, mirror_taps: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return regressors ``zf(k-1), zf(k-2), ...`` (rows, n, taps) and targets z(k) (rows, n)."""
    frames, n = part.shape
    m = len(mirror_taps)
    rows = frames - (m - 1) - count  # the first needs zf(k-taps), which needs m values of z
    if rows < 1:
        return np.zeros((0, n, count)), np.zeros((0, n))
    filtered = sliding_window_view(part, m, axis=0) @ mirror_taps[::-1]
    late = sliding_window_view(filtered, count, axis=0)[:rows, :, ::-1]
    return np.asarray(late), part[m - 1 + count :]


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
    taps: int = 32,
) -> PredictionTable:
    """Replay controllers on frames that nothing was fitted to, and compare with the model.

    Other rows are the integrator of least residual by the model, a least-squares predictor from
    the frames of the fit (:func:`least_squares_predictor`), and the least residual of any linear
    controller if the model is the truth.

    Parameters
    ----------
    plant : TipTiltPlant
        The model, with its sensor gain in the sensor matrix. For an honest comparison it was not
        identified from the frames of the test.
    open_loop : (frames, n) array_like
        Recorded pseudo-open-loop series ``z(k) = phi_tot(k-1) + w(k) / g`` [nm].
    controllers : mapping of str to Controller or Design
        What is compared, by name.
    stretches : sequence of (start, stop), optional
        Contiguous usable frames, over which controllers run; by default the whole record. The
        halves of :func:`split_halves` are to fit and to test.
    measurements : (frames, q) array_like, optional
        Measurements y(k) of the loop that ran, for its own row [nm].
    running : Controller or Design, optional
        The controller that ran, if it is known, for what the model says of it.
    noise_error_nm : float or (q,) array_like, optional
        Standard error of the plant's noise [nm].
    imaging : Imaging, optional
        The camera, for Strehl ratios on at most two axes.
    taps : int, optional
        Coefficients of the predictor per mode.

    Returns
    -------
    PredictionTable
        Rows in this order: what ran, best integrator, controllers, predictor, limit.

    Raises
    ------
    ProblemError
        If sizes clash, a name is taken or a value is out of its range, or frames are too few.
    UnstableLoopError
        If a controller does not hold the plant's loop.
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
    ['what ran', 'Kalman', 'limit of performance']
    >>> bool(abs(table["Kalman"].deviations) < 4)
    True
    """
    require_instance(plant, TipTiltPlant)
    if imaging is not None:
        require_instance(imaging, Imaging)
    hardware = plant.hardware
    series, runs = check_series(open_loop, hardware.modes, stretches)
    fit, later = split_halves(runs, len(series))
    test, replayed = settled_test(runs, later, hardware.frame_rate_hz)
    noise = mode_noise(hardware, plant.R, noise_error_nm=noise_error_nm)
    for name in controllers:
        if name in _RESERVED or not isinstance(name, str):
            raise ProblemError(
                f"a controller may not be called {name!r}; its row is taken. Give another name."
            )
    predictor, _ = least_squares_predictor(series, hardware, taps=taps, stretches=fit)
    designs = {INTEGRATOR: model_integrator(plant), **controllers, PREDICTOR: predictor}
    loops = {name: _close_stable_loop(plant, name, thing) for name, thing in designs.items()}
    measured = {name: replay(loop, series, replayed) for name, loop in loops.items()}
    if measurements is not None:
        y, _ = check_series(measurements, hardware.n_measurements, test, "measurements")
        if len(y) != len(series):
            raise ProblemError(
                f"measurements must have the {len(series)} frames of open_loop; got {len(y)}."
            )
        measured = {RAN: y @ inverse_sensor(hardware).T, **measured}
    if running is not None:
        if measurements is None:
            raise ProblemError("the controller that ran needs its measurements; got none.")
        loops[RAN] = _close_stable_loop(plant, RAN, running)
    rows = []
    for name, residual in measured.items():
        estimate = estimate_residual(gather(residual, test), test, *noise)
        promised = None
        if name in loops:  # as a record has it, in means over frames
            promised = residual_budget(loops[name], plant, frame_means=True).total_nm2
        rows.append(_build_row(name, estimate, promised, imaging))
    notes = _note_refuted(rows)
    try:
        limit = least_model_residual(plant, frame_means=True)
    except ProblemError as error:  # modes that do not decouple, or a mirror without a limit
        notes = (f"no {LIMIT}: {error}", *notes)
    else:
        along = limit.directions.T * limit.variance_nm2 @ limit.directions
        rows.append(_build_row(LIMIT, None, along, imaging))
    return PredictionTable(entries=tuple(rows), fit=fit, test=test, notes=notes)


def stable_designs(
    plant: TipTiltPlant,
    options: Mapping[str, Mapping[str, Any]],
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[dict[str, Design], list[str]]:
    """Return designs that hold a plant's loop, by titles, and why others are missing.

    ``options`` are those of each method, by its name.
    """
    inputs = PlantInputs(plant=plant, design_defaults=defaults)
    designs, notes = dict[str, Design](), list[str]()
    for name, given in options.items():
        title = method_named(name).title
        try:
            design = design_request(name, given).build(inputs)
        except LbtSynthError as error:
            notes.append(f"no {title}: {str(error).rstrip('.')}")
            continue
        if close_loop(plant.hardware, design.controller).is_stable:
            designs[title] = design
        else:
            notes.append(f"no {title}: its loop is not stable at the identified sensor gain")
    return designs, notes


def compare_on_record(
    record: LoopRecord,
    half: IdentifiedModel,
    controllers: Mapping[str, Controller | Design],
    *,
    running: Controller | None = None,
    imaging: Imaging | None = None,
) -> PredictionTable:
    """Return what controllers leave of the second half of a record, by a model of the first."""
    return prediction_against_data(
        half.plant(),
        record.pseudo_open_loop(half.sensor_gains),
        controllers,
        stretches=record.stretches(),
        measurements=None if record.commands is None else record.measurements,
        running=running,
        noise_error_nm=[axis.noise_error_nm for axis in half.axes],
        imaging=imaging,
    )


def _note_refuted(rows: list[PredictionRow]) -> tuple[str, ...]:
    """Return a note on the rows for which the noise cannot be right."""
    refuted = {row.name: row.replayed for row in rows if row.replayed and row.replayed.refuted}
    if not refuted:
        return ()
    most = max(replayed.errors_below_zero for replayed in refuted.values())
    return (
        f"no residual on the data of {', '.join(refuted)}: its variance is {most:.3g} standard "
        "errors below zero, more than chance; the model has more noise than the data, or another "
        "sensor gain. Identify the noise again.",
    )


def _close_stable_loop(plant: TipTiltPlant, name: str, thing: Controller | Design) -> ClosedLoop:
    loop = close_loop(plant.hardware, as_controller(thing))
    try:
        loop.require_stable()
    except UnstableLoopError as error:
        raise UnstableLoopError(
            f"{name}: {error}", spectral_radius=error.spectral_radius
        ) from error
    return loop


def _build_row(
    name: str,
    replayed: ResidualEstimate | None,
    promised: FloatArray | None,
    imaging: Imaging | None,
) -> PredictionRow:
    """Return a row of a residual on the data and a covariance (n, n) that the model promises."""
    measured = np.nan if replayed is None else replayed.rms_nm
    model = np.nan if promised is None else float(np.sqrt(np.trace(promised)))
    strehl = promised_strehl = np.nan
    if imaging is not None and replayed is not None:
        strehl = replayed.strehl(imaging)
    if imaging is not None and promised is not None:
        promised_strehl = jitter_strehl(promised, imaging=imaging)
    return PredictionRow(
        name=name,
        replayed_nm=measured,
        replayed_error_nm=np.nan if replayed is None else replayed.rms_error_nm,
        model_nm=model,
        ratio=measured / model if model > 0 else np.nan,
        strehl=strehl,
        model_strehl=promised_strehl,
        replayed=replayed,
        model_axis_nm=None if promised is None else frozen_copy(np.sqrt(np.diag(promised))),
    )
