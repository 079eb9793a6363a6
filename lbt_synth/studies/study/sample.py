"""One sample of a study: its loop, its disturbances, and its slow reference evaluation."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.ensemble import EXPECTED_ERRORS
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.samples import Keys
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.errors import ConfigError, refuse_config
from lbt_synth.loop import ClosedLoop, residual_budget, simulate, strehl
from lbt_synth.loop.simulation.failing_sensors import simulate_sensors
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.loop.strehl import jitter_spread_nm, widest_jitter_nm
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.storage.words import count_text
from lbt_synth.studies.study.study import (
    DELAY_ERROR,
    NOISE_FACTOR,
    RESIDUALS,
    BatchResult,
    Failure,
    Study,
    StudyController,
)
from lbt_synth.validation import FloatArray

_PART = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)((?:\[[0-9]{1,6}\])*)")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """One sample of a study."""

    config: Config  # what designs assume
    hardware: LoopHardware  # the real loop: that of ``config`` with the delay error
    truth: Truth  # what it really meets: that of ``config`` with the real noise


def make_sample(study: Study, values: Sequence[float] | FloatArray) -> Sample:
    """Make the sample of a row of ``Study.values``."""
    base = study.config
    full = base.settings.model_dump()
    content = base.settings.model_dump(exclude_unset=True)
    for parameter, value in zip(study.parameters, values, strict=True):
        for keys in parameter.places:
            set_number(content, keys, float(value), full=full)
    config = build_config(validate_sections(FileSection, content, base.source), base.source)
    parameters = study.parameters_by_name(values)
    delay_error, factor = parameters.get(DELAY_ERROR, 0.0), parameters.get(NOISE_FACTOR, 1.0)
    hardware, truth = config.hardware, config.truth
    with refuse_config(f"the real loop, with {DELAY_ERROR} and {NOISE_FACTOR}"):
        if delay_error != 0:
            hardware = replace(hardware, delay_frames=hardware.delay_frames + delay_error)
        if factor != 1:
            truth = replace(truth, noise_nm=truth.noise_nm * factor)
    return Sample(config=config, hardware=hardware, truth=truth)


def parse_path(path: str) -> Keys:
    """Parse a path into its keys."""
    keys: list[str | int] = []
    for part in path.split("."):
        found = _PART.fullmatch(part)
        if found is None:
            raise ConfigError(
                f"{path!r} is no path in a configuration; expected one such as "
                "truth.vibrations[0].frequency_hz."
            )
        keys.append(found[1])
        keys += [int(index) for index in re.findall(r"[0-9]+", found[2])]
    return tuple(keys)


def find_number(content: Mapping[str, Any], path: str) -> float:
    """Return the number to which a path leads; refuse a path that leads to none."""
    here: Any = content
    parent: Any = {}
    walked = ""
    for key in parse_path(path):
        place = walked or "the configuration"
        kind: Any = list if isinstance(key, int) else dict
        if not isinstance(here, kind):
            says = "is no list" if kind is list else "has no keys"
            raise ConfigError(f"{path}: {place} {says}; {_describe(here)}.")
        if isinstance(key, int):
            if key >= len(here):
                raise ConfigError(
                    f"{path}: {place} has {count_text(len(here), 'entry', 'entries')}, "
                    f"counted from 0; got [{key}]."
                )
            walked += f"[{key}]"
        else:
            if key not in here:
                close = difflib.get_close_matches(key, list(here), n=1, cutoff=0.6)
                hint = f"did you mean {close[0]}? " if close else ""
                raise ConfigError(
                    f"{path}: {place} has no {key}; {hint}there are {', '.join(sorted(here))}."
                )
            walked += f".{key}" if walked else key
        parent, here = here, here[key]
    if here is None:
        entries = parent.items() if isinstance(parent, dict) else ()
        there = [k for k, v in entries if type(v) in (int, float)]
        others = f" Numbers that are set there: {', '.join(sorted(there))}." if there else ""
        raise ConfigError(
            f"{path} is not set in the configuration, so it cannot be varied.{others}"
        )
    if type(here) not in (int, float):
        raise ConfigError(f"{path} must lead to a number of the configuration; {_describe(here)}.")
    return cast(float, here)


def _describe(value: Any) -> str:
    if isinstance(value, dict):
        return f"it is a section with {', '.join(sorted(value))}"
    if isinstance(value, list):
        return f"it is a list of {len(value)}"
    return "it is not set" if value is None else f"it is {value!r}"


def set_number(
    content: dict[str, Any], keys: Keys, value: float, *, full: Mapping[str, Any]
) -> None:
    """Set a number that :func:`find_number` finds in ``full``, the content with its defaults.

    Missing sections on the way are added, missing lists copied. An integer stays one if it can.
    """
    here: Any = content
    whole: Any = full
    for key in keys[:-1]:
        whole = whole[key]
        if isinstance(here, dict) and key not in here:
            here[key] = deepcopy(whole) if isinstance(whole, list) else {}
        here = here[key]
    whole_number = isinstance(whole[keys[-1]], int) and float(value).is_integer()
    here[keys[-1]] = int(value) if whole_number else float(value)


def evaluate_rows(
    study: Study,
    values: FloatArray,
    start: int,
    *,
    left: Mapping[int, Sequence[StudyController]] | None = None,
) -> BatchResult:
    """Evaluate consecutive rows of ``Study.values``, (b, parameters), one by one.

    ``left`` names the controllers to evaluate on each row, by its place; all of them by default.
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
        radii = [loop.radius_per_frame for loop in loops.values() if loop.is_stable]
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
    return design.close(sample.hardware, sensor_gain=sample.truth.sensor_gain)


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
    sizes = {"frames": section.frames, "cases": section.cases, "settle_frames": settle}
    truth, hardware = sample.truth, loop.hardware
    if loop.reads_others:
        filters = {frozenset[str](): loop.controller}
        run = simulate_sensors(filters, truth, hardware=hardware, seed=seed, drops=(), **sizes)
    else:
        run = simulate(loop.controller, truth, hardware=hardware, seed=seed, **sizes)
    return {
        "strehl": float(np.mean(run.strehl(sample.config.imaging))),
        "residual_nm": float(np.sqrt(np.mean(run.rms_nm**2))),
    }
