"""Controllers compared on data that nothing was fitted to, beside what the model promises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.identification.prediction.predictor import least_squares_predictor
from lbt_synth.identification.prediction.residual import (
    PredictionData,
    check_series,
    drop_settling,
    frames_to_settle,
    inverse_sensor,
    predict_residual,
    prediction_data,
)
from lbt_synth.identification.prediction.residual_estimate import (
    ResidualEstimate,
    estimate_residual,
)
from lbt_synth.identification.prediction.table import PredictionRow, PredictionTable
from lbt_synth.identification.stretches import Stretches, checked_stretches, split_halves
from lbt_synth.linear import Controller
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, jitter_strehl, model_budget
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models import TipTiltPlant
from lbt_synth.validation import FloatArray, frozen_copy, integer, require_instance

RAN = "what ran"
INTEGRATOR = "best integrator"
PREDICTOR = "least-squares predictor"
LIMIT = "limit of performance"
_RESERVED = (RAN, INTEGRATOR, PREDICTOR, LIMIT)


def prediction_against_data(
    plant: TipTiltPlant,
    open_loop: Any,
    controllers: Mapping[str, Controller | Design],
    *,
    stretches: Sequence[tuple[int, int]] | None = None,
    fit: Sequence[tuple[int, int]] | None = None,
    test: Sequence[tuple[int, int]] | None = None,
    measurements: Any = None,
    running: Controller | Design | None = None,
    noise_error_nm: Any = 0.0,
    imaging: Imaging | None = None,
    taps: int = 32,
    settle_frames: int | None = None,
) -> PredictionTable:
    """Replay controllers on frames that nothing was fitted to, and compare with the model.

    Beside the controllers stand the integrator of least residual by the model, a predictor by
    least squares on the frames of the fit (:func:`least_squares_predictor`), and the least
    residual of any linear controller where the model is the truth.

    Parameters
    ----------
    plant : TipTiltPlant
        The model: turbulence, vibrations, noise, and the loop with its sensor gain in the sensor
        matrix. For an honest comparison it has not seen the frames of the test.
    open_loop : (frames, n) array_like
        Recorded pseudo-open-loop series ``z(k) = phi_tot(k-1) + w(k) / g`` [nm].
    controllers : mapping of str to Controller or Design
        What is compared, by name.
    stretches : sequence of (start, stop), optional
        Contiguous usable frames; by default the whole record. They are halved by
        :func:`split_halves`, unless ``fit`` and ``test`` are given.
    fit, test : sequence of (start, stop), optional
        Frames to fit the predictor to and frames to test on; both or neither.
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
    settle_frames : int, optional
        Frames dropped before each stretch of the test; by default as many as the slowest of the
        loops needs (:func:`replayed_residual`).

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
    n = hardware.modes
    series, usable = check_series(open_loop, n, stretches)
    fitted, tested = _split_frames(usable, fit, test, len(series))
    data = prediction_data(
        series,
        hardware,
        noise_nm2=plant.R,
        noise_error_nm=noise_error_nm,
        sensor_gain=1.0,
        stretches=tested,
    )
    chosen = {INTEGRATOR: model_integrator(plant).controller}
    for name, thing in controllers.items():
        if name in _RESERVED or not isinstance(name, str):
            raise ProblemError(
                f"a controller may not be called {name!r}; its row is taken. Give another name."
            )
        chosen[name] = _as_controller(thing)
    predictor = least_squares_predictor(series, hardware, taps=taps, stretches=fitted)
    loops = {name: _close_stable_loop(plant, name, one) for name, one in chosen.items()}
    loops[PREDICTOR] = _close_stable_loop(plant, PREDICTOR, predictor.controller)
    settle = (
        max(frames_to_settle(loop) for loop in loops.values())
        if settle_frames is None
        else integer(settle_frames, "settle_frames", at_least=0)
    )
    entries = []
    if measurements is not None:
        promised = None
        if running is not None:
            loop = _close_stable_loop(plant, RAN, _as_controller(running))
            promised = model_budget(loop, plant).total_nm2
        ran = _measured_residual(data, plant, measurements, settle)
        entries.append(_build_row(RAN, ran, promised, imaging))
    elif running is not None:
        raise ProblemError("the controller that ran needs its measurements; got none.")
    for name, loop in loops.items():
        found = predict_residual(data, loop, settle)
        entries.append(_build_row(name, found, model_budget(loop, plant).total_nm2, imaging))
    notes: tuple[str, ...] = ()
    try:
        limit = least_model_residual(plant)
    except ProblemError as error:  # modes that do not decouple, or a mirror without a limit
        notes = (f"no {LIMIT}: {error}",)
    else:
        along = limit.directions.T * limit.variance_nm2 @ limit.directions
        entries.append(_build_row(LIMIT, None, along, imaging))
    notes += _note_refuted(entries)
    return PredictionTable(
        entries=tuple(entries),
        fit=fitted,
        test=drop_settling(tested, settle),
        settle_frames=settle,
        notes=notes,
    )


def _note_refuted(entries: Sequence[PredictionRow]) -> tuple[str, ...]:
    """Note rows for which the noise cannot be right."""
    below = {
        entry.name: entry.replayed.errors_below_zero
        for entry in entries
        if entry.replayed is not None and entry.replayed.refuted
    }
    if not below:
        return ()
    return (
        f"no residual on the data of {', '.join(below)}: its variance is {max(below.values()):.3g} "
        "standard errors below zero, more than chance; the model has more noise than the data, or "
        "another sensor gain. Identify the noise again.",
    )


def _split_frames(
    usable: Stretches, fit: Any, test: Any, frames: int
) -> tuple[Stretches, Stretches]:
    if (fit is None) != (test is None):
        raise ProblemError("fit and test must both be given, or neither; got one of them.")
    if fit is None:
        return split_halves(usable, frames)
    fitted, tested = checked_stretches(fit, frames), checked_stretches(test, frames)
    for a, b in fitted:
        for c, d in tested:
            if a < d and c < b:
                raise ProblemError(
                    f"the test must have frames that the fit has not; got ({a}, {b}) to fit and "
                    f"({c}, {d}) to test."
                )
    return fitted, tested


def _as_controller(thing: Controller | Design) -> Controller:
    if isinstance(thing, Design):
        return thing.controller
    require_instance(thing, Controller)
    return thing


def _close_stable_loop(plant: TipTiltPlant, name: str, controller: Controller) -> ClosedLoop:
    loop = close_loop(plant.hardware, controller)
    try:
        loop.require_stable()
    except UnstableLoopError as error:
        raise UnstableLoopError(
            f"{name}: {error}", spectral_radius=error.spectral_radius
        ) from error
    return loop


def _measured_residual(
    data: PredictionData, plant: TipTiltPlant, measurements: Any, settle: int
) -> ResidualEstimate:
    """Return the residual of the loop that ran, from its own measurements on the same frames."""
    q = plant.hardware.n_measurements
    y, _ = check_series(measurements, q, data.stretches, "measurements")
    if len(y) != len(data.open_loop):
        raise ProblemError(
            f"measurements must have the {len(data.open_loop)} frames of open_loop; got {len(y)}."
        )
    kept = drop_settling(data.stretches, settle)
    back = inverse_sensor(plant.hardware)
    return estimate_residual(
        np.concatenate([y[start:stop] @ back.T for start, stop in kept]),
        kept,
        noise_nm2=data.noise_nm2,
        noise_error_nm4=data.noise_error_nm4,
    )


def _build_row(
    name: str, found: ResidualEstimate | None, promised: FloatArray | None, imaging: Imaging | None
) -> PredictionRow:
    strehl = promised_strehl = float("nan")
    if imaging is not None:
        strehl = strehl if found is None else found.strehl(imaging)
        if promised is not None:
            promised_strehl = jitter_strehl(promised, imaging=imaging)
    return PredictionRow(
        name=name,
        replayed=found,
        model_nm2=None if promised is None else frozen_copy(promised),
        strehl=strehl,
        model_strehl=promised_strehl,
    )
