"""Evaluate samples one by one with the library's own calls, as the slow reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from lbt_synth.config.ensemble import EXPECTED_ERRORS
from lbt_synth.design import Design
from lbt_synth.loop import ClosedLoop, close_loop, residual_budget, simulate, strehl
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.loop.strehl import jitter_spread_nm, widest_jitter_nm
from lbt_synth.studies.study.sample import Sample, make_sample
from lbt_synth.studies.study.study import RESIDUALS, BatchResult, Failure, Study, StudyController
from lbt_synth.validation import FloatArray


def evaluate_rows(
    study: Study,
    values: FloatArray,
    start: int,
    *,
    left: Mapping[int, Sequence[StudyController]] | None = None,
) -> BatchResult:
    """Evaluate consecutive rows of ``Study.values``, (b, parameters), one by one.

    ``left`` names the controllers to evaluate on each row, by its place; all of them by default.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.studies.study.reference_evaluation import evaluate_rows
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> batch = evaluate_rows(study, study.values(0, 2), 0)
    >>> batch.columns["kalman.strehl"].round(3).tolist(), batch.columns["kalman.stable"].tolist()
    ([0.837, 0.821], [1.0, 1.0])
    """
    if left is None:
        left = dict.fromkeys(range(len(values)), study.controllers)
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures: list[Failure] = []
    for i, controllers in sorted(left.items()):
        some = replace(study, controllers=tuple(controllers))
        with np.errstate(all="ignore"):  # what overflows fails its checks
            row, failed = evaluate_row(some, values[i], start + i)
        failures += failed
        for name, value in row.items():
            columns[name][i] = value
    return BatchResult(start=start, columns=columns, failures=tuple(failures))


def evaluate_row(
    study: Study, values: FloatArray, row: int
) -> tuple[dict[str, float], tuple[Failure, ...]]:
    """Evaluate one sample, and return its results by column and its failures."""
    failures: list[Failure] = []
    loops: dict[str, ClosedLoop] = {}
    out: dict[str, float] = {}
    with _note_failure(failures, row, study.controllers):
        sample = make_sample(study, values)
        for controller in study.controllers:
            with _note_failure(failures, row, [controller]):
                design = design_for_sample(controller, sample)
                loops[controller.name] = close_sample_loop(sample, design)
        # frames to drop: the same for all controllers, which meet the same disturbances
        radii = [loop.spectral_radius for loop in loops.values() if loop.is_stable]
        least = study.config.settings.simulation.settle_frames
        settle = max([least, *map(settling_frames, radii)])
        for controller in study.controllers:
            if (loop := loops.get(controller.name)) is None:
                continue
            with _note_failure(failures, row, [controller]):
                found = {"stable": float(loop.is_stable)}
                if loop.is_stable and study.settings.evaluation == "exact":
                    found |= _evaluate_exactly(loop, sample)
                elif loop.is_stable:
                    seed = study.simulation_seed(row)
                    found |= _simulate(loop, sample, seed=seed, settle=settle)
                out |= {f"{controller.name}.{column}": value for column, value in found.items()}
    return out, tuple(failures)


@contextmanager
def _note_failure(
    failures: list[Failure], row: int, controllers: Sequence[StudyController]
) -> Iterator[None]:
    """Note an error that fails controllers on a sample, and not the study."""
    try:
        yield
    except EXPECTED_ERRORS as error:
        text = " ".join(str(error).split()) or type(error).__name__
        failures += [Failure(row=row, controller=each.name, error=text) for each in controllers]


def design_for_sample(controller: StudyController, sample: Sample) -> Design:
    """Return a controller's design, made for the sample if it has none for all."""
    if controller.design is not None:
        return controller.design
    assert controller.request is not None  # only a gain file has none
    return sample.config.design(controller.request)


def close_sample_loop(sample: Sample, design: Design) -> ClosedLoop:
    """Close the real loop of a sample with a design."""
    return close_loop(sample.hardware, design.controller, sensor_gain=sample.truth.sensor_gain)


def _evaluate_exactly(loop: ClosedLoop, sample: Sample) -> dict[str, float]:
    """Return the exact residual of a stable loop by origin, and its Strehl ratio."""
    budget, imaging = residual_budget(loop, sample.truth), sample.config.imaging
    spread = jitter_spread_nm(budget.gaussian_nm2[None], budget.line_amplitudes_nm[None])[0]
    # 0 beyond the widest jitter that is integrated, as in EnsembleResiduals.strehl
    ratio = strehl(budget, imaging) if spread <= widest_jitter_nm(imaging) else 0.0
    return {"strehl": ratio} | {name: getattr(budget, part) for name, part in RESIDUALS.items()}


def _simulate(loop: ClosedLoop, sample: Sample, *, seed: int, settle: int) -> dict[str, float]:
    """Return the mean Strehl ratio and the residual of a stable loop, simulated as configured."""
    section = sample.config.settings.simulation
    run = simulate(
        loop.controller,
        sample.truth,
        hardware=sample.hardware,
        frames=section.frames,
        cases=section.cases,
        seed=seed,
        settle_frames=settle,
    )
    return {
        "strehl": float(np.mean(run.strehl(sample.config.imaging))),
        "residual_nm": float(np.sqrt(np.mean(run.rms_nm**2))),
    }
