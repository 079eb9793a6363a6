"""Replay one row of a study: its configuration, its designs, and its results once more."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lbt_synth.config import save_config
from lbt_synth.config.ensemble import EXPECTED_ERRORS
from lbt_synth.config.load import validate_sections
from lbt_synth.config.plant_and_truth import turbulence_sections
from lbt_synth.config.schema import Ar2Section, FileSection
from lbt_synth.config.write import turbulence_content
from lbt_synth.errors import ProblemError
from lbt_synth.files import save_gain
from lbt_synth.methods.request import DesignRequest
from lbt_synth.storage.atomic_files import refuse_replacing
from lbt_synth.studies.grid import Failure
from lbt_synth.studies.study.run import read_manifest, study_parts
from lbt_synth.studies.study.sample import Sample, design_for_sample, evaluate_row, make_sample
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Study
from lbt_synth.validation import integer

_NOISELESS = "has no noise, which no configuration takes: there is none to simulate it with."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """A row of a study, computed again."""

    row: int  # its number
    parameters: dict[str, float]  # its parameters
    stored: dict[str, float]  # its results in the study; empty if it has none yet
    # its results computed now, by the reference evaluation; without those that failed
    fresh: dict[str, float]
    failures: tuple[Failure, ...]  # what failed now
    # files that were written: the configuration, and the designs for this sample
    files: tuple[Path, ...]
    unwritten: str = ""  # why there is no configuration; empty if there is one


def replay_row(study: Study, directory: str | os.PathLike[str], row: int) -> Replay:
    """Compute one row of a study again, and write it as a configuration.

    ``row_N.yaml`` is the configuration of the sample with its real delay and noise, and with the
    seed of its simulation: ``simulate row_N.yaml GAIN`` closes the loop of the sample. Designs
    for each sample, which assume the delay and the noise of ``config``, are ``row_N_NAME.fits``.

    Parameters
    ----------
    study : Study
        The study.
    directory : path-like
        Its directory, finished or not.
    row : int
        The number of the row.

    Returns
    -------
    Replay
        Parameters, stored and fresh results.

    Raises
    ------
    ProblemError
        If the study has no such row, or the configuration refuses its numbers.
    OutputError
        If the directory belongs to another study, or cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = lbt.studies.replay_row(lbt.studies.load_study("examples/study.yaml"), folder, 3)
    >>> [path.name for path in again.files], round(again.fresh["kalman.strehl"], 3)
    (['row_3.yaml'], 0.832)
    """
    row = integer(row, "row", at_least=0)
    if row >= study.samples:
        raise ProblemError(f"the study has rows 0 to {study.samples - 1}; got row {row}.")
    folder = Path(directory)
    stored = {}
    if read_manifest(folder, study) is not None:
        parts = study_parts(folder, study)
        for (start, stop), path in parts.paths().items():
            if start <= row < stop:
                numbers = parts.read(path)[0][row - start]
                stored = dict(zip(study.result_columns, numbers.tolist(), strict=True))
    values = study.values(row, row + 1)[0]
    fresh, failures = evaluate_row(study, values, row)
    sample = _, _, truth = make_sample(study, values)
    has_noise = bool(np.all(np.asarray(truth.noise_nm) > 0))
    return Replay(
        row=row,
        parameters=study.parameters_by_name(values),
        stored=stored,
        fresh=fresh,
        failures=tuple(failures),
        files=_write_files(study, folder, row, sample, with_config=has_noise),
        unwritten="" if has_noise else f"row {row} {_NOISELESS}",
    )


def _write_files(
    study: Study, folder: Path, row: int, sample: Sample, *, with_config: bool
) -> tuple[Path, ...]:
    """Write the configuration of a sample and its own designs, and return their paths."""
    path = folder / f"row_{row}.yaml"
    own = {
        folder / f"row_{row}_{name}.fits": controller
        for name, controller in study.controllers.items()
        if isinstance(controller, DesignRequest)
    }
    refuse_replacing([path, *own], study.inputs)
    files = []
    if with_config:
        settings, comments = _row_settings(study, row, sample)
        files.append(save_config(path, settings, comments=comments))
    for gain, controller in own.items():
        with contextlib.suppress(*EXPECTED_ERRORS):  # they are among the failures
            files.append(save_gain(gain, design_for_sample(controller, sample)))
    return tuple(files)


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
        if any(isinstance(section, Ar2Section) for section in turbulence_sections(config.settings)):
            # keep what was fitted above the noise that designs assume
            sections = [turbulence_content(model) for model in config.plant.turbulence]
            same = all(section == sections[0] for section in sections)
            content["model"]["turbulence"] = sections[0] if same else sections
    content.setdefault("simulation", {})["seed"] = study.simulation_seed(row)
    return validate_sections(FileSection, content, study.config.source), comments
