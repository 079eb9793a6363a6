"""Tables II and III of the paper, simulated end to end with SPECULA."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Design, integrator
from lbt_synth.errors import ProblemError
from lbt_synth.interop import EndToEndSetup, calibrate
from lbt_synth.interop.specula.optics import specula_version
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop
from lbt_synth.methods.request import reference_design
from lbt_synth.models import SinusoidalVibration, Truth
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.storage.rows import column, fill_row, table_row
from lbt_synth.studies.grid import Sweep, loop_columns
from lbt_synth.studies.paper import parameters as given
from lbt_synth.studies.paper.parameters import TABLE_II, TABLE_III, VIBRATION_HZ, PublishedRow
from lbt_synth.validation import FloatArray, choice

_NUMBERS = ("strehl", "tip_tilt_gain", "tip_rms_nm", "tilt_rms_nm", "other_modes_strehl")
CLASSICAL_GAIN = 0.5
# "by increasing the integrator's gain"; this times the optical gain of the loop, 0.55, is the
# effective gain that fits Table II (parameters.CLASSICAL_EFFECTIVE_GAIN)
CLASSICAL_GAIN_VIBRATION = 0.56


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedRow:
    """One row of a table for one controller: cases that differ in their seed only."""

    table: str  # "II" or "III"
    label: str
    method: str
    error_hz: float | None  # true frequency less the model's; None without vibration
    paper: float  # the paper's Strehl ratio [%], or nan
    controller: Controller  # of tip and tilt
    truth: Truth
    cases: dict[str, dict[str, Any]]  # by name


@table_row
class EndToEndEntry:
    """One row of a table for one controller, simulated; ``strehls`` are those of each seed [%]."""

    table: str = column(help='Table, "II" or "III"')
    label: str = column("row", key="row", help="Its row")
    method: str = column("method", help="Its controller")
    error_hz: float | None = column(
        unit="Hz", help="Frequency of the vibration less that of the model"
    )
    strehls: tuple[float, ...] = field()
    strehl: float = column(
        "end to end", key="strehl_percent", format=".1f", help="Mean Strehl ratio over seeds [%]"
    )
    scatter: float = column(
        "scatter",
        key="scatter_points",
        format=".1f",
        help="Standard deviation over seeds [points]; nan for one",
    )
    seeds: int = column("seeds", help="How many there are")
    paper: float = column(
        "paper", key="paper_strehl_percent", format=".1f", help="The paper's [%], or nan"
    )
    modal: float = column(
        "modal",
        key="modal_strehl_percent",
        format=".1f",
        help="Prediction of the modal analysis with the measured optical gain and the measured "
        "Strehl ratio of the other modes, mean over seeds [%]; 0 where the loop is unstable",
    )
    optical_gain: float = column(
        "optical gain", format=".3f", help="Optical gain of tip and tilt, mean over seeds"
    )
    tip_rms_nm: float = column("tip", unit="nm", format=".0f", help="Residual, rms over seeds")
    tilt_rms_nm: float = column("tilt", unit="nm", format=".0f", help="Residual, rms over seeds")
    other_modes: float = column(
        "other modes",
        unit="%",
        key="other_modes_strehl_percent",
        format=".1f",
        help="Strehl ratio without tip and tilt, mean over seeds",
    )


def plan_tables(
    setup: EndToEndSetup,
    designs: Mapping[str, Design] | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    row_seeds: Sequence[int] = (0,),
    tables: Sequence[str] = ("II", "III"),
) -> list[PlannedRow]:
    """Plan the rows and cases of both tables for a system.

    The filters are those of :func:`~lbt_synth.studies.paper.parameters.paper_filters`, designed
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
    for name, design in (designs or {}).items():
        setup.controller(design)  # refuses a filter of another loop or of other sizes
        if name in ("classical", *given.filter_problems()):
            raise ProblemError(f"the name {name} is taken by the paper's own; rename the file.")
    lines = [line for line in (*TABLE_II, *TABLE_III) if line.table in tables]
    return [
        row
        for line in lines
        for row in _plan_line(
            setup,
            line,
            designs or {},
            seeds if line.table == "II" or line.error_hz == 0 else row_seeds,
        )
    ]


def _plan_line(
    setup: EndToEndSetup, line: PublishedRow, designs: Mapping[str, Design], seeds: Sequence[int]
) -> Iterator[PlannedRow]:
    """Yield the paper's controllers, then the fixed designs.

    The paper's filters follow the frequency of the model; under the others the vibration moves.
    """
    true_hz = moved_hz = None
    if line.error_hz is not None:
        true_hz, moved_hz = VIBRATION_HZ, VIBRATION_HZ + line.error_hz
    plans: list[tuple[str, str, Design, float | None, float]] = []  # cases, method, paper's ratio
    if line.table == "II":
        gain = CLASSICAL_GAIN_VIBRATION if line.vibration else CLASSICAL_GAIN
        classical = integrator(setup.system.hardware, gain=gain)
        plans.append(("classical", "classical", classical, moved_hz, line.classical))
    for method, (plant, bound) in given.filter_problems().items():
        plant = retuned_plant(plant, line.model_hz - VIBRATION_HZ, hold="driving")
        design = reference_design(method, plant, bound)
        name = f"{method}-{line.model_hz:g}hz"
        plans.append((name, method, design, true_hz, getattr(line, method)))
    plans += [(method, method, fixed, moved_hz, np.nan) for method, fixed in designs.items()]
    for name, method, design, frequency_hz, paper in plans:
        shakes = tuple(
            replace(shake, frequency_hz=frequency_hz)
            for shake in given.PAPER_TRUTH.vibrations
            if frequency_hz is not None and isinstance(shake, SinusoidalVibration)
        )
        vibration = "none" if frequency_hz is None else f"{frequency_hz:g}hz"
        yield PlannedRow(
            table=line.table,
            label=line.label,
            method=method,
            error_hz=line.error_hz,
            paper=paper,
            controller=design.controller,
            truth=replace(given.PAPER_TRUTH, vibrations=shakes),
            cases={
                f"{name}-vibration-{vibration}-seed-{seed}": {
                    "setup": replace(setup, vibrations=shakes, motions=(), seed=seed),
                    "controller": design.controller,
                }
                for seed in seeds
            },
        )


def end_to_end_tables(
    setup: EndToEndSetup,
    directory: str | os.PathLike[str],
    designs: Mapping[str, Design] | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    row_seeds: Sequence[int] = (0,),
    tables: Sequence[str] = ("II", "III"),
    executor: Executor | None = None,
    workers: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[EndToEndEntry]:
    """Run Tables II and III of Agapito et al. 2008 end to end, or what is missing of them.

    Each run has a file of its own: started again in the same directory with the same arguments,
    only the missing ones run. All controllers of a row meet the same air, vibrations and noise.

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
    executor : concurrent.futures.Executor, optional
        Runs the cases, in processes for example; it is left open. By default they run here.
    workers : int, optional
        How many cases the executor runs at once, if it does not say so itself.
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
    calibrate(setup.system, cache=cache)  # once for all processes
    cases = all_cases(rows)
    versions = {"lbt-synth": lbt_synth.__version__, "specula": specula_version()}
    content = json.dumps({"versions": versions, "cases": cases}, sort_keys=True, default=_plain)
    waiting = list(cases.values())
    sweep = Sweep(
        folder=Path(directory),
        columns=_NUMBERS,
        rows=len(cases),
        digest=hashlib.sha256(content.encode()).hexdigest(),
    )
    runs, _ = sweep.run(
        _run_cases,
        lambda some: (waiting[slice(*some)], cache),
        part_rows=1,
        executor=executor,
        workers=workers,
        progress=progress,
    )
    results = {
        name: dict(zip(_NUMBERS, row, strict=True))
        for name, row in zip(cases, runs.results.tolist(), strict=True)
    }
    return make_entries(rows, results, setup)


def _run_cases(
    cases: Sequence[Mapping[str, Any]], cache: str | os.PathLike[str] | None
) -> tuple[dict[str, FloatArray], list[Any]]:
    """Return the main numbers of some runs."""
    runs = [case["setup"].run(case["controller"], cache=cache).summary() for case in cases]
    return {name: np.array([run[name] for run in runs]) for name in _NUMBERS}, []


def _plain(value: Any) -> Any:
    """Return an array or a dataclass as what JSON can hold."""
    if is_dataclass(value):
        return {entry.name: getattr(value, entry.name) for entry in fields(value)}
    return value.tolist()


def all_cases(rows: Iterable[PlannedRow]) -> dict[str, dict[str, Any]]:
    """Return the cases of all rows, each once."""
    return {name: case for row in rows for name, case in row.cases.items()}


def make_entries(
    rows: Iterable[PlannedRow], results: Mapping[str, Mapping[str, Any]], setup: EndToEndSetup
) -> list[EndToEndEntry]:
    """Make the entries of the tables from the results of their cases."""
    entries = []
    for row in rows:
        runs = [results[name] for name in row.cases]
        strehls, gain, tip, tilt, others = (np.array([run[n] for run in runs]) for n in _NUMBERS)
        entry = fill_row(
            EndToEndEntry,
            row,
            strehls=tuple((100 * strehls).tolist()),
            strehl=100 * float(np.mean(strehls)),
            scatter=100 * float(np.std(strehls, ddof=1)) if strehls.size > 1 else np.nan,
            seeds=strehls.size,
            modal=float(np.mean([_predict_strehl(row, run, setup) for run in runs])),
            optical_gain=float(np.mean(gain)),
            tip_rms_nm=float(np.mean(tip**2) ** 0.5),
            tilt_rms_nm=float(np.mean(tilt**2) ** 0.5),
            other_modes=100 * float(np.mean(others)),
        )
        entries.append(entry)
    return entries


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
    loop = close_loop(system.hardware, row.controller, sensor_gain=gain)
    numbers = loop_columns(loop, truth, imaging, frame_means=True)
    return 100 * numbers["strehl"] if loop.is_stable else 0.0


def rms_modal_difference(table: Iterable[EndToEndEntry], method: str) -> float:
    """Return the rms of end-to-end less modal over Table III, for one controller [points]."""
    differences = [e.strehl - e.modal for e in table if e.table == "III" and e.method == method]
    return float(np.sqrt(np.mean(np.square(differences))))
