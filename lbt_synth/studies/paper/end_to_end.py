"""Tables II and III of the paper, simulated end to end with SPECULA."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lbt_synth.design import Design, hinf, integrator, kalman
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.interop import EndToEndSetup, calibrate
from lbt_synth.interop.specula.json_cases import make_case, run_case
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, residual_budget, strehl
from lbt_synth.models import SinusoidalVibration, Truth, retuned_plant
from lbt_synth.storage import run_cases
from lbt_synth.studies.paper import parameters as given
from lbt_synth.studies.paper.published import TABLE_II, TABLE_III, TableII, TableIII
from lbt_synth.validation import choice

CLASSICAL_GAIN = 0.5
# "by increasing the integrator's gain"; this times the optical gain of the loop, 0.55, is the
# effective gain that fits Table II (parameters.CLASSICAL_EFFECTIVE_GAIN)
CLASSICAL_GAIN_VIBRATION = 0.56
_FILTERS = ("kalman", "hinf")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedRow:
    """One row of a table for one controller: cases that differ in their seed only."""

    table: str  # "II" or "III"
    label: str
    method: str
    error_hz: float | None  # of the model's frequency; None without vibration
    paper: float  # the paper's Strehl ratio [%], or nan
    controller: Controller  # of tip and tilt
    truth: Truth
    cases: dict[str, dict[str, Any]]  # by name


@dataclass(frozen=True, slots=True, kw_only=True)
class EndToEndEntry:
    """One row of a table for one controller, simulated.

    Attributes
    ----------
    table, label, method : str
        Table, row and controller.
    error_hz : float or None
        Frequency of the model less that of the vibration [Hz].
    strehls : tuple of float
        Strehl ratio of each seed [%].
    paper : float
        The paper's [%], or nan.
    modal : float
        Prediction of the modal analysis with the measured optical gain and the measured
        Strehl ratio of the other modes, mean over seeds [%]; 0 where the loop is unstable.
    optical_gain : float
        Optical gain of tip and tilt, mean over seeds.
    tip_rms_nm, tilt_rms_nm : float
        Residuals, root mean square over seeds [nm].
    other_modes : float
        Strehl ratio without tip and tilt, mean over seeds [%].
    """

    table: str
    label: str
    method: str
    error_hz: float | None
    strehls: tuple[float, ...]
    paper: float
    modal: float
    optical_gain: float
    tip_rms_nm: float
    tilt_rms_nm: float
    other_modes: float

    @property
    def strehl(self) -> float:
        """Mean over seeds [%]."""
        return float(np.mean(self.strehls))

    @property
    def scatter(self) -> float:
        """Standard deviation over seeds [points]; nan for one."""
        return float(np.std(self.strehls, ddof=1)) if len(self.strehls) > 1 else float("nan")


def plan_tables(
    setup: EndToEndSetup,
    designs: Mapping[str, Design] | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    row_seeds: Sequence[int] = (0,),
    tables: Sequence[str] = ("II", "III"),
) -> list[PlannedRow]:
    """Plan the rows and cases of both tables for a system.

    The filters are those of :func:`~lbt_synth.studies.paper.tables.paper_filters`, designed
    for each frequency of Table III. Further designs are fixed: for them the vibration moves
    instead of the model, by the same error.
    """
    for table in tables:
        choice(table, "tables", ("II", "III"))
    hardware = setup.system.hardware
    if (hardware.frame_rate_hz, hardware.delay_frames) != (given.FRAME_RATE_HZ, given.DELAY_FRAMES):
        raise ProblemError(
            f"the paper's loop runs at {given.FRAME_RATE_HZ:g} Hz with a delay of "
            f"{given.DELAY_FRAMES:g} frames; got {hardware.frame_rate_hz:g} Hz and "
            f"{hardware.delay_frames:g} frames."
        )
    rows: list[PlannedRow] = []
    fixed = dict(designs or {})
    for name, design in fixed.items():
        setup.controller(design)  # refuses a filter of another loop or of other sizes
        if name in ("classical", *_FILTERS):
            raise ProblemError(f"the name {name} is taken by the paper's own; rename the file.")
    if "II" in tables:
        rows += _plan_table_ii(setup, fixed, seeds)
    if "III" in tables:
        rows += _plan_table_iii(setup, fixed, seeds, row_seeds)
    return rows


class _TableRow(NamedTuple):
    """One row of a table, for all its controllers."""

    table: str
    label: str
    error_hz: float | None
    model_hz: float
    seeds: Sequence[int]

    @property
    def truth_hz(self) -> float | None:
        """Frequency of the vibration if the model moves; None without vibration."""
        return None if self.error_hz is None else given.VIBRATION_HZ

    @property
    def moved_hz(self) -> float | None:
        """Frequency of the vibration if the design stays; None without vibration."""
        return None if self.error_hz is None else given.VIBRATION_HZ - self.error_hz


def _plan_table_ii(
    setup: EndToEndSetup, fixed: Mapping[str, Design], seeds: Sequence[int]
) -> Iterator[PlannedRow]:
    for published in TABLE_II:
        shaken = published.vibration
        row = _TableRow(
            table="II",
            label="vibration" if shaken else "no vibration",
            error_hz=0.0 if shaken else None,
            model_hz=given.VIBRATION_HZ,
            seeds=seeds,
        )
        gain = CLASSICAL_GAIN_VIBRATION if shaken else CLASSICAL_GAIN
        classical = integrator(setup.system.hardware, gain=gain).controller
        yield _plan_row(setup, row, "classical", classical, published.classical)
        yield from _plan_controllers(setup, row, published, fixed)


def _plan_table_iii(
    setup: EndToEndSetup,
    fixed: Mapping[str, Design],
    seeds: Sequence[int],
    row_seeds: Sequence[int],
) -> Iterator[PlannedRow]:
    for published in TABLE_III:
        error = published.model_hz - given.VIBRATION_HZ
        row = _TableRow(
            table="III",
            label=f"{published.model_hz:.1f} Hz",
            error_hz=error,
            model_hz=published.model_hz,
            seeds=seeds if error == 0 else row_seeds,
        )
        yield from _plan_controllers(setup, row, published, fixed)


def _plan_controllers(
    setup: EndToEndSetup,
    row: _TableRow,
    published: TableII | TableIII,
    designs: Mapping[str, Design],
) -> Iterator[PlannedRow]:
    """Yield the paper's filters, then the fixed designs."""
    for method in _FILTERS:
        controller = _paper_filter(method, row.model_hz)
        yield _plan_row(setup, row, method, controller, getattr(published, method))
    for name, design in designs.items():
        yield _plan_row(setup, row, name, design.controller, float("nan"))


def _plan_row(
    setup: EndToEndSetup, row: _TableRow, method: str, controller: Controller, paper: float
) -> PlannedRow:
    tuned = method in _FILTERS
    true_hz = row.truth_hz if tuned else row.moved_hz
    lines: tuple[SinusoidalVibration, ...] = ()
    if true_hz is not None:
        shake = given.PAPER_TRUTH.vibrations[0]
        assert isinstance(shake, SinusoidalVibration)
        lines = (replace(shake, frequency_hz=true_hz),)
    vibration = "none" if true_hz is None else f"{true_hz:g}hz"
    name = f"{method}-{row.model_hz:g}hz" if tuned else method
    return PlannedRow(
        table=row.table,
        label=row.label,
        method=method,
        error_hz=row.error_hz,
        paper=paper,
        controller=controller,
        truth=replace(given.PAPER_TRUTH, vibrations=lines),
        cases={
            f"{name}-vibration-{vibration}-seed-{seed}": make_case(
                setup, controller, vibrations=lines, seed=seed
            )
            for seed in row.seeds
        },
    )


def _paper_filter(method: str, model_hz: float) -> Controller:
    plant = given.kalman_plant() if method == "kalman" else given.hinf_plant()
    plant = retuned_plant(plant, model_hz - given.VIBRATION_HZ, hold="driving")
    if method == "kalman":
        return kalman(plant).controller
    return hinf(plant, gamma=given.HINF_GAMMA * given.NOISE_NM, route="riccati").controller


def end_to_end_tables(
    setup: EndToEndSetup,
    directory: str | os.PathLike[str],
    designs: Mapping[str, Design] | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    row_seeds: Sequence[int] = (0,),
    tables: Sequence[str] = ("II", "III"),
    jobs: int = 1,
    executor: Executor | None = None,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[EndToEndEntry]:
    """Run Tables II and III of Agapito et al. 2008 end to end, or what is missing of them.

    Each run is a case of :func:`run_cases`: started again in the same directory, only the
    missing ones run. All controllers of a row meet the same air, vibrations and noise.

    Parameters
    ----------
    setup : EndToEndSetup
        The system, for the paper's frame rate and delay.
    directory : path-like
        An existing directory for the results of the runs.
    designs : mapping of str to Design, optional
        Fixed designs beside the paper's filters; the vibration moves under them.
    seeds, row_seeds : sequence of int, optional
        Seeds of Table II and of the row at 20 Hz; seeds of the other rows.
    tables : sequence of str, optional
        Which of "II" and "III".
    jobs : int, optional
        Processes.
    executor : concurrent.futures.Executor, optional
        Runs the cases instead.
    cache : path-like, optional
        Directory for calibrations and phase screens.
    progress : callable, optional
        Called with the number of runs that were found or finished since its last call.

    Returns
    -------
    list of EndToEndEntry
        One per row and controller, ours beside the paper's and the modal analysis.

    Raises
    ------
    MissingExtraError
        If SPECULA is missing: ``pip install "lbt-synth[e2e]"``.
    ProblemError
        If the loop is not that of the paper, or a design is for another.
    OutputError
        If the directory holds results of other settings, or cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> setup = lbt.load_config("examples/lbt.yaml").end_to_end
    >>> lbt.studies.end_to_end_tables(setup, "nowhere/at/all", tables=["IV"])
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: tables must be one of II, III; got 'IV'.
    """
    rows = plan_tables(setup, designs, seeds=seeds, row_seeds=row_seeds, tables=tables)
    return run_tables(
        setup, rows, directory, jobs=jobs, executor=executor, cache=cache, progress=progress
    )


def run_tables(
    setup: EndToEndSetup,
    rows: Sequence[PlannedRow],
    directory: str | os.PathLike[str],
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[EndToEndEntry]:
    """Run what is missing of tables of :func:`plan_tables`; see :func:`end_to_end_tables`."""
    calibrate(setup.system, cache=cache)  # once for all processes
    results = run_cases(
        functools.partial(run_case, cache=cache),
        all_cases(rows),
        directory,
        jobs=jobs,
        executor=executor,
        progress=progress,
    )
    return make_entries(rows, results, setup)


def all_cases(rows: Iterable[PlannedRow]) -> dict[str, dict[str, Any]]:
    """Return the cases of all rows, each once."""
    return {name: case for row in rows for name, case in row.cases.items()}


def make_entries(
    rows: Iterable[PlannedRow], results: Mapping[str, Mapping[str, Any]], setup: EndToEndSetup
) -> list[EndToEndEntry]:
    """Make the entries of the tables from the results of their cases."""
    entries = []
    for row in rows:
        found = [results[name] for name in row.cases]
        entries.append(
            EndToEndEntry(
                table=row.table,
                label=row.label,
                method=row.method,
                error_hz=row.error_hz,
                paper=row.paper,
                strehls=tuple(100 * one["strehl"] for one in found),
                modal=_mean([_predict_strehl(row, one, setup) for one in found]),
                optical_gain=_mean([one["tip_tilt_gain"] for one in found]),
                tip_rms_nm=_mean([one["tip_rms_nm"] ** 2 for one in found]) ** 0.5,
                tilt_rms_nm=_mean([one["tilt_rms_nm"] ** 2 for one in found]) ** 0.5,
                other_modes=100 * _mean([one["other_modes_strehl"] for one in found]),
            )
        )
    return entries


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _predict_strehl(row: PlannedRow, result: Mapping[str, Any], setup: EndToEndSetup) -> float:
    """Return the Strehl ratio of the modal analysis [%], with the gain measured in a run."""
    system = setup.system
    gain = result["tip_tilt_gain"]
    if gain <= 0:
        return 0.0
    truth = replace(row.truth, sensor_gain=gain)
    imaging = Imaging(
        diameter_m=system.diameter_m,
        obstruction=system.obstruction,
        wavelength_um=system.imaging_wavelength_um,
        other_modes=result["other_modes_strehl"],
    )
    try:
        loop = close_loop(system.hardware, row.controller, sensor_gain=gain)
        return 100 * strehl(residual_budget(loop, truth), imaging)
    except UnstableLoopError:
        return 0.0


def rms_modal_difference(table: Iterable[EndToEndEntry], method: str) -> float:
    """Return the rms of end-to-end less modal over Table III, for one controller [points]."""
    differences = [e.strehl - e.modal for e in table if e.table == "III" and e.method == method]
    return float(np.sqrt(np.mean(np.square(differences))))
