"""Replay one row of a study: its configuration, its designs, and its results once more."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.config import save_config
from lbt_synth.config.ensemble import EXPECTED_ERRORS
from lbt_synth.config.load import validate_sections
from lbt_synth.config.plant_and_truth import turbulence_sections
from lbt_synth.config.schema import Ar2Section, FileSection
from lbt_synth.errors import ProblemError
from lbt_synth.files import save_gain
from lbt_synth.storage.atomic_files import refuse_replacing
from lbt_synth.studies.study.output_files import read_row
from lbt_synth.studies.study.reference_evaluation import (
    design_for_sample,
    evaluate_row,
)
from lbt_synth.studies.study.sample import Sample, make_sample
from lbt_synth.studies.study.store import (
    list_parts,
    read_manifest,
    require_same_study,
    require_unchanged,
)
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Failure, Study
from lbt_synth.validation import integer

_NOISELESS = (
    "row {row} has no noise, which no configuration takes: there is none to simulate it with."
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """A row of a study, computed again.

    Attributes
    ----------
    row : int
        Its number.
    parameters : dict of str to float
        Its parameters.
    stored : dict of str to float
        Its results in the study; empty if it has none yet.
    fresh : dict of str to float
        Its results computed now, by the reference evaluation; without those that failed.
    failures : tuple of Failure
        What failed now.
    files : tuple of pathlib.Path
        Files that were written: the configuration, and the designs for this sample.
    unwritten : str
        Why there is no configuration; empty if there is one.
    """

    row: int
    parameters: dict[str, float]
    stored: dict[str, float]
    fresh: dict[str, float]
    failures: tuple[Failure, ...]
    files: tuple[Path, ...]
    unwritten: str = ""


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
    manifest = read_manifest(folder)
    stored = {}
    if manifest is not None:
        require_same_study(manifest, study.digest, folder)
        require_unchanged(folder, manifest)
        stored = read_row(folder, study, row, list_parts(folder))
    values = study.values(row, row + 1)[0]
    fresh, failures = evaluate_row(study, values, row)
    sample = make_sample(study, values)
    return Replay(
        row=row,
        parameters=study.parameters_by_name(values),
        stored=stored,
        fresh=fresh,
        failures=failures,
        files=_write_files(study, folder, row, sample),
        unwritten="" if sample.noise_factor > 0 else _NOISELESS.format(row=row),
    )


def _write_files(study: Study, folder: Path, row: int, sample: Sample) -> tuple[Path, ...]:
    """Write the configuration of a sample and its own designs, and return their paths."""
    own = [controller for controller in study.controllers if controller.for_sample]
    path = folder / f"row_{row}.yaml"
    gains = {c.name: folder / f"row_{row}_{c.name}.fits" for c in own}
    refuse_replacing([path, *gains.values()], study.inputs)
    files = []
    if sample.noise_factor > 0:
        settings, comments = row_settings(study, row, sample)
        files.append(save_config(path, settings, comments=comments))
    for controller in own:
        try:
            design = design_for_sample(controller, sample)
        except EXPECTED_ERRORS:  # it is among the failures
            continue
        files.append(save_gain(gains[controller.name], design))
    return tuple(files)


def row_settings(study: Study, row: int, sample: Sample) -> tuple[FileSection, dict[str, str]]:
    """Return the configuration of the real loop of a sample, and comments on it."""
    content = sample.config.settings.model_dump(exclude_unset=True)
    comments = {"": f"Row {row} of the study {study.source.name}: the real loop of the sample."}
    if sample.delay_error_frames != 0:
        content["loop"]["delay_frames"] = sample.hardware.delay_frames
        assumed = sample.config.hardware.delay_frames
        comments["loop.delay_frames"] = f"designs assume {assumed:.12g} ({DELAY_ERROR})"
    if sample.noise_factor != 1:
        _set_noise(content, sample, comments)
    content.setdefault("simulation", {})["seed"] = study.simulation_seed(row)
    settings = validate_sections(FileSection, content, study.config.source)
    return settings, comments


def _set_noise(content: dict[str, Any], sample: Sample, comments: dict[str, str]) -> None:
    """Set the real noise, and keep the turbulence that was fitted with the assumed noise."""
    config = sample.config
    for name in ("noise_mas", "pyramid"):
        content["sensor"].pop(name, None)
    content["sensor"]["noise_nm"] = np.asarray(sample.truth.noise_nm).tolist()
    assumed_nm = ", ".join(f"{value:.12g}" for value in np.ravel(config.noise_nm))
    comments["sensor.noise_nm"] = f"designs assume {assumed_nm} ({NOISE_FACTOR})"
    if any(isinstance(section, Ar2Section) for section in turbulence_sections(config.settings)):
        # fitted above the noise that designs assume
        sections = [
            {
                "kind": "ar",
                "coefficients": np.asarray(model.coefficients).tolist(),
                "driving_rms_nm": model.driving_rms_nm,
            }
            for model in config.plant.turbulence
        ]
        same = all(section == sections[0] for section in sections)
        content["model"]["turbulence"] = sections[0] if same else sections
