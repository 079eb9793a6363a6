"""Run a study, or what is missing of it, and write its results; replay a row of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lbt_synth.config.build import turbulence_sections
from lbt_synth.config.load import validate_sections
from lbt_synth.config.samples import Keys, array_keys, build_ensemble
from lbt_synth.config.schema import FileSection
from lbt_synth.config.write import config_text, turbulence_content
from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, LbtSynthError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.linear import solve_dare
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.methods.request import DesignRequest
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.atomic_files import (
    UNFINISHED,
    open_atomically,
    refuse_replacing,
    write_atomically,
)
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies.grid import Failure, Result, Sweep, ensemble_columns, loop_columns, refuse
from lbt_synth.studies.study.study import (
    DELAY_ERROR,
    NOISE_FACTOR,
    Sample,
    Study,
    design_for_sample,
    make_sample,
)
from lbt_synth.validation import FloatArray, IntArray, integer, require_instance

PARTS, RESULTS, FAILED = "parts", "results.csv", "failed.csv"
PAGE, PRINT = "summary.html", "summary.pdf"
_PARAMETER, _RESULT = "%.12g", "%.9g"  # formats in CSV; a replayed row has all digits
# Rows of a part whose samples are evaluated together: some tenths of a second, of which the check
# of one sample by itself is a fifth. Where each sample takes milliseconds or seconds, a killed
# study shall lose few of them.
_ROWS_TOGETHER, _ROWS_ONE_BY_ONE = 8192, 16
# errors that refuse a sample; LinAlgError is a ValueError
EXPECTED_ERRORS = (LbtSynthError, ArithmeticError, ValueError)
_DELAY: Keys = ("loop", "delay_frames")  # which decides the states of a filter
_AGREEMENT = 1e-5  # of a sample evaluated both ways, relative and absolute

Evaluate = Callable[[Study, FloatArray, int], Result]


def evaluate_samples(study: Study, values: FloatArray, start: int) -> Result:
    """Evaluate consecutive rows of ``Study.values`` from a start; nan is where there is no result.

    Samples whose configurations differ by numbers that its builders take as arrays are evaluated
    together, and so are the equations of their Kalman filters. All others are evaluated one by one,
    as is one sample of each group, and the two answers must agree.
    """
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures: list[Failure] = []
    remaining: dict[int, list[str]] = {}  # controllers to evaluate one by one, by sample
    for name, controller in study.controllers.items():
        for rows, results in _evaluate_groups(study, controller, values):
            for column, numbers in results.items():
                columns[f"{name}.{column}"][rows] = numbers
            i = int(rows[rows.size // 2])
            alone = replace(study, controllers={name: controller})
            among = {column: float(columns[column][i]) for column in alone.result_columns}
            _require_agreement(alone, values[i], start + i, among)
        for i in np.flatnonzero(np.isnan(columns[f"{name}.stable"])).tolist():
            remaining.setdefault(i, []).append(name)
    for i, names in sorted(remaining.items()):
        some = replace(study, controllers={name: study.controllers[name] for name in names})
        with np.errstate(all="ignore"):  # what overflows fails its checks
            single, failed = evaluate_row(some, values[i], start + i)
        failures += failed
        for column, value in single.items():
            columns[column][i] = value
    return columns, failures


def are_evaluated_together(study: Study, controller: Design | DesignRequest) -> bool:
    """Whether many samples of a controller can be evaluated at once."""
    if isinstance(controller, Design):
        return not controller.other_sensors
    # a Kalman filter without options, designed for each sample
    plain = controller.method.batched and not controller.given
    return plain and not study.config.hardware.suite.sensors


def _evaluate_groups(
    study: Study, controller: Design | DesignRequest, values: FloatArray
) -> Iterator[tuple[IntArray, dict[str, FloatArray]]]:
    """Yield what could be evaluated together: rows, and their columns."""
    if not are_evaluated_together(study, controller):
        return
    keys = array_keys(study.config.settings)
    if isinstance(controller, DesignRequest):
        keys -= {_DELAY}
    places = enumerate(study.places.values())
    apart = [i for i, numbers in places if not keys.issuperset(numbers)]
    _, which, counts = np.unique(values[:, apart], axis=0, return_inverse=True, return_counts=True)
    for group in np.flatnonzero(counts >= min(2, len(values))):
        rows = np.flatnonzero(which.reshape(-1) == group)  # that differ by these keys only
        with suppress(*EXPECTED_ERRORS):
            yield rows, _evaluate_group(study, controller, values[rows], keys)
            continue
        made = []  # without the one that fails
        for row in rows.tolist():
            with suppress(*EXPECTED_ERRORS):
                make_sample(study, values[row])
                made.append(row)
        accepted = np.array(made, dtype=np.intp)
        with suppress(*EXPECTED_ERRORS, IndexError):  # none may make a sample
            yield accepted, _evaluate_group(study, controller, values[accepted], keys)


def _evaluate_group(
    study: Study, controller: Design | DesignRequest, values: FloatArray, keys: set[Keys]
) -> dict[str, FloatArray]:
    """Return the columns of samples that differ by numbers of some keys only."""
    config, hardware, _ = make_sample(study, values[0])
    by_name = dict(zip(study.parameter_names, values.T, strict=True))
    places = [(place, by_name[name]) for name, keys_of in study.places.items() for place in keys_of]
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        if isinstance(controller, DesignRequest):
            matrices = _kalman_matrices([make_sample(study, row)[0].plant for row in values])
        else:
            matrices = textbook_matrices([controller.controller])
        loops = build_ensemble(
            config,
            {place: numbers for place, numbers in places if place in keys},
            delay_error_frames=by_name.get(DELAY_ERROR, np.zeros(len(values))),
            noise_factor=by_name.get(NOISE_FACTOR, np.ones(len(values))),
        )
        return ensemble_columns(matrices, hardware, loops, config.imaging)


def _kalman_matrices(plants: list[TipTiltPlant]) -> tuple[FloatArray, ...]:
    """Design a Kalman filter for each plant, all at once; A, B, C, D in textbook form."""
    A, C, Q, R = (np.stack([getattr(plant, name) for plant in plants]) for name in "ACQR")
    gains = transpose(solve_dare(transpose(A), transpose(C), Q, R).gain_feedback)
    filters = [plant.controller(gain) for plant, gain in zip(plants, gains, strict=True)]
    systems = [controller.to_statespace() for controller in filters]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def _require_agreement(
    study: Study, values: FloatArray, row: int, among: Mapping[str, float]
) -> None:
    """Refuse a batch in which a sample differs from its evaluation by itself."""
    single, failures = evaluate_row(study, values, row)
    why = failures[0][2].rstrip(".") if failures else "one of the two is wrong"
    for name, value in among.items():
        expected = single.get(name, np.nan)
        if not np.isclose(value, expected, _AGREEMENT, _AGREEMENT, equal_nan=True):
            raise CertificateError(
                f"row {row} has {name} {value:.9g} among others, and {expected:.9g} by itself: "
                f"{why}. This is a fault of the program; please report it with the study file."
            )


def evaluate_row(
    study: Study, values: FloatArray, row: int
) -> tuple[dict[str, float], list[Failure]]:
    """Evaluate one sample, and return its results by column and its failures."""
    failures: list[Failure] = []
    results: dict[str, float] = {}
    with note_failure(failures, row, study.controllers):
        sample = config, hardware, truth = make_sample(study, values)
        for name, controller in study.controllers.items():
            with note_failure(failures, row, [name]):
                design = design_for_sample(controller, sample)
                loop = design.close(hardware, sensor_gain=truth.sensor_gain)
                columns = loop_columns(loop, truth, config.imaging)
                results |= {f"{name}.{column}": value for column, value in columns.items()}
    return results, failures


@contextmanager
def note_failure(failures: list[Failure], row: int, controllers: Iterable[str]) -> Iterator[None]:
    """Note an error that fails controllers on a sample, and not the study."""
    try:
        yield
    except EXPECTED_ERRORS as error:
        text = " ".join(str(error).split()) or type(error).__name__
        failures += [(row, name, text) for name in controllers]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRun:
    """What a run of a study did, and all results."""

    results: Path  # the table of results, and that of failures
    failed: Path
    columns: dict[str, FloatArray]  # row, parameters and results by name, (n,) each
    failures: tuple[Failure, ...]  # row, controller and error, in the order of the rows
    computed: int  # how many rows this run computed
    computing_s: float  # time of all parts, summed over processes [s]
    seconds: float  # time of this run [s]
    new: bool  # whether this run wrote the table of results


def run_study(
    study: Study,
    directory: str | os.PathLike[str],
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    evaluate: Evaluate = evaluate_samples,
    progress: Callable[[int], None] | None = None,
) -> StudyRun:
    """Run what is missing of a study, and write its results.

    Every part, a fixed number of rows, is a file in ``parts`` as soon as it is computed, written
    completely or not at all: a study that is killed at any moment, or whose worker died, resumes
    where it was. When all rows are computed, ``results.csv`` is written with one row per sample in
    order, ``failed.csv`` with the failures, and a gain file for each design for the whole study.

    Parameters
    ----------
    study : Study
        The study.
    directory : path-like
        An existing directory.
    executor : concurrent.futures.Executor, optional
        Runs the parts, in processes or as a Dask ``Client.get_executor()``; it is left open. By
        default they run in this process.
    workers : int, optional
        How many parts the executor runs at once, if it does not say so itself; twice as many are
        in flight.
    evaluate : callable, optional
        ``evaluate(study, values, start)`` returns columns and failures of rows of
        ``study.values``, as :func:`evaluate_samples` does. Other processes must be able to import
        it by name.
    progress : callable, optional
        Called with the number of rows that were found or finished since its last call.

    Returns
    -------
    StudyRun
        What was done, and all results. A finished study is not run again.

    Raises
    ------
    OutputError
        If the directory belongs to another study, is in use or cannot be written, files in it
        would be replaced, or a part in it is damaged.
    NumericalError
        If a worker dies, or an executor breaks; what is finished is kept.

    Examples
    --------
    >>> import dataclasses, tempfile, lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> few = dataclasses.replace(study, settings=study.settings.model_copy(update={"samples": 4}))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run, again = (lbt.studies.run_study(few, folder) for _ in range(2))
    >>> run.results.name, run.computed, again.computed, run.columns["kalman.strehl"].shape
    ('results.csv', 4, 0, (4,))
    """
    require_instance(study, Study)
    if workers is not None:
        integer(workers, "workers", at_least=1)
    folder, began = Path(directory), time.perf_counter()
    refuse_replacing(output_paths(folder, study), study.inputs)
    sweep = study_sweep(folder, study)
    if not sweep.paths():
        for path in output_paths(folder, study):
            if path.exists():
                why = "is not of a study in this directory, and would be replaced. Name another"
                refuse(path, f"{why} directory, or delete it.")
    together = all(are_evaluated_together(study, one) for one in study.controllers.values())
    outcome, computed = sweep.run(
        evaluate,
        lambda rows: (study, study.values(*rows), rows[0]),
        part_rows=_ROWS_TOGETHER if together else _ROWS_ONE_BY_ONE,
        executor=executor,
        workers=workers,
        progress=progress,
    )
    table = np.column_stack([np.arange(study.samples), study.values(), outcome.results])
    return StudyRun(
        results=folder / RESULTS,
        failed=folder / FAILED,
        columns=dict(zip(study.columns, np.ascontiguousarray(table.T), strict=True)),
        failures=tuple(outcome.failures),
        computed=computed,
        computing_s=outcome.seconds,
        new=_write_outputs(folder, study, table, outcome.failures),
        seconds=time.perf_counter() - began,
    )


def study_sweep(folder: Path, study: Study) -> Sweep:
    """Return the sweep of a study in its directory."""
    place, columns = folder / PARTS, study.result_columns
    return Sweep(folder=place, columns=columns, rows=study.samples, digest=study.digest)


def output_paths(folder: Path, study: Study) -> list[Path]:
    """Return the files that a study writes into its directory, without its parts."""
    designs = [f"{name}.fits" for name in study.designed]
    return [folder / name for name in (RESULTS, FAILED, PAGE, PRINT, *designs)]


def _write_outputs(folder: Path, study: Study, table: FloatArray, failures: list[Failure]) -> bool:
    """Write designs and tables that are missing; return whether one of the tables was."""
    for path in folder.glob(UNFINISHED):
        path.unlink()  # what a killed process left
    for name, design in study.designed.items():
        if not (folder / f"{name}.fits").exists():
            save_gain(folder / f"{name}.fits", design)
    results, failed = folder / RESULTS, folder / FAILED
    new = not (results.exists() and failed.exists())
    if not failed.exists():
        write_atomically(failed, csv_bytes(("row", "controller", "error"), failures))
    if not results.exists():
        formats = [_PARAMETER] * len(study.parameter_names) + [_RESULT] * len(study.result_columns)
        heading, style = ",".join(study.columns), {"delimiter": ",", "comments": ""}
        with open_atomically(results) as stream:
            np.savetxt(stream, table, ["%d", *formats], header=heading, **style)
    return new


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """A row of a study, computed again."""

    stored: dict[str, float]  # its results in the study; empty if it has none yet
    # its results computed now, by the reference evaluation; without those that failed
    fresh: dict[str, float]
    failures: tuple[Failure, ...]  # what failed now, the configuration among it
    files: tuple[Path, ...]  # that were written: the configuration, and the designs for this sample

    @property
    def changed(self) -> list[str]:
        """Names of the stored results that are not what is computed now."""
        now = [self.fresh.get(name, np.nan) for name in self.stored]
        same = np.isclose([*self.stored.values()], now, equal_nan=True)
        return [name for name, one in zip(self.stored, same, strict=True) if not one]


def replay_row(study: Study, directory: str | os.PathLike[str], row: int) -> Replay:
    """Compute one row of a study again, and write it as a configuration.

    ``row_N.yaml`` is the configuration of the sample with its real delay and noise, and with its
    number as the seed: ``simulate row_N.yaml GAIN`` closes the loop of the sample. Designs for each
    sample, which assume the delay and the noise of ``config``, are ``row_N_NAME.fits``.
    """
    row = integer(row, "row", at_least=0)
    if row >= study.samples:
        raise ProblemError(f"the study has rows 0 to {study.samples - 1}; got row {row}.")
    folder = Path(directory)
    stored, sweep = {}, study_sweep(folder, study)
    for (start, stop), path in sweep.paths().items():
        if start <= row < stop:
            numbers = sweep.read(path).results[row - start]
            stored = dict(zip(study.result_columns, numbers.tolist(), strict=True))
    values = study.values(row, row + 1)[0]
    fresh, failures = evaluate_row(study, values, row)
    sample, path = make_sample(study, values), folder / f"row_{row}.yaml"
    designs = {
        folder / f"row_{row}_{name}.fits": controller
        for name, controller in study.controllers.items()
        if isinstance(controller, DesignRequest)
    }
    refuse_replacing([path, *designs], study.inputs)
    files = []
    with note_failure(failures, row, ["configuration"]):
        settings, comments = _row_settings(study, row, sample)
        files.append(write_atomically(path, config_text(settings, comments).encode()))
    for gain, controller in designs.items():
        with suppress(*EXPECTED_ERRORS):  # they are among the failures
            files.append(save_gain(gain, design_for_sample(controller, sample)))
    return Replay(stored=stored, fresh=fresh, failures=tuple(failures), files=tuple(files))


def _row_settings(study: Study, row: int, sample: Sample) -> tuple[FileSection, dict[str, str]]:
    """Return the configuration of the real loop of a sample, and comments on it."""
    config, hardware, truth = sample
    content = config.settings.model_dump(exclude_unset=True)
    comments = {"": f"Row {row} of the study {study.source.name}: the real loop of the sample."}
    if hardware is not config.hardware:
        content["loop"]["delay_frames"] = hardware.delay_frames
        assumed = config.hardware.delay_frames
        comments["loop.delay_frames"] = f"designs assume {assumed:.12g} ({DELAY_ERROR})"
    if truth is not config.truth:
        sensor = content["sensor"]
        content["sensor"] = {k: v for k, v in sensor.items() if k not in ("noise_mas", "pyramid")}
        content["sensor"]["noise_nm"] = np.asarray(truth.noise_nm).tolist()
        assumed_nm = ", ".join(f"{value:.12g}" for value in np.ravel(config.noise_nm))
        comments["sensor.noise_nm"] = f"designs assume {assumed_nm} ({NOISE_FACTOR})"
        if any(section.kind == "ar2" for section in turbulence_sections(config.settings)):
            # keep what was fitted above the noise that designs assume
            sections = [turbulence_content(model) for model in config.plant.turbulence]
            same = all(section == sections[0] for section in sections)
            content["model"]["turbulence"] = sections[0] if same else sections
    content.setdefault("simulation", {})["seed"] = row
    return validate_sections(FileSection, content, study.config.source), comments
