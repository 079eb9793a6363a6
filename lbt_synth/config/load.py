"""Read a configuration file and build what it describes; templates of files to begin with."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML

from lbt_synth.config.build import (
    build_atmosphere,
    build_end_to_end_setup,
    build_plant,
    build_truth,
    measurement_noise_nm,
    reference_gain,
    vibration_rms_nm,
)
from lbt_synth.config.schema import FileSection, describe_error
from lbt_synth.errors import ConfigError, FileError, ProblemError, name_file
from lbt_synth.loop import Imaging
from lbt_synth.methods.method import DesignInputs
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.models import Atmosphere, LoopHardware, TipTiltPlant, Truth
from lbt_synth.storage.array_file import error_reason
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import FloatArray, choice, file_path

if TYPE_CHECKING:
    from lbt_synth.design import Design
    from lbt_synth.interop.specula.optics import EndToEndSetup

Checked = TypeVar("Checked", bound=BaseModel)
_LARGEST_BYTES = 2**17  # of a file; ruamel.yaml may read no more than 30 kB per second
_FILES = resources.files(__package__)  # of templates and examples
_MOST_ERROR_HZ, _USUAL_ERROR = 3.5, 0.175  # of frequencies, unless the file says
_ERROR_STEPS = [step / 7 for step in range(-7, 8)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Config(Summarised):
    """A configuration and what it describes.

    Attributes
    ----------
    settings : FileSection
        The file's values, checked; sections as attributes.
    plant : TipTiltPlant
        Plant of the design, with all sensors.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    atmosphere : Atmosphere or None
        Turbulence and telescope; None where the file has no atmosphere.
    noise_nm : float or (q,) ndarray
        Measurement noise per frame [nm], of all measurements or of each.
    sensor_gain : float
        Sensor gain that the design assumes, with which single real gains are compared: the
        mean of ``model.sensor_gain`` if it is a list.
    source : pathlib.Path
        The file.
    """

    settings: FileSection
    plant: TipTiltPlant
    truth: Truth
    imaging: Imaging
    atmosphere: Atmosphere | None
    noise_nm: float | FloatArray
    sensor_gain: float
    source: Path

    def _brief(self) -> str:
        return f"{self.source.name}, {self.hardware._brief()}"

    def _summarise(self) -> Summary:
        plant, truth = self.plant._summarise(), self.truth._summarise()
        return Summary(tables=[*plant.tables, *truth.tables])

    @property
    def hardware(self) -> LoopHardware:
        """The loop."""
        return self.plant.hardware

    @property
    def errors_hz(self) -> list[float]:
        """Frequency errors of studies: those of the file, or of what it says of its vibrations."""
        errors_hz = self.settings.robustness.errors_hz
        if errors_hz is not None:
            return errors_hz
        lines = self.truth.lines_hz
        if not lines:
            return [0.0]
        stated = self.truth.frequency_errors_hz
        room = self.hardware.frame_rate_hz / 2 - max(lines)
        most = min(_MOST_ERROR_HZ, _USUAL_ERROR * max(lines), room / 2)
        most = most if stated is None else max(stated)
        return [most * step for step in _ERROR_STEPS] if most else [0.0]

    def design(self, method: str | DesignRequest, **options: Any) -> Design:
        """Design a controller for the configuration.

        Parameters
        ----------
        method : str
            Method of synthesis, as ``lbt-synth design --method`` names it.
        **options
            Its options, as those of ``lbt-synth design``; the configuration gives others.

        Returns
        -------
        Design
            Certified design.

        Raises
        ------
        ProblemError
            If there is no such method, or it does not take an option.
        ConfigError
            If the configuration lacks what the method needs.
        SynthesisError
            If the design fails, or does not pass its checks.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> lbt.load_config("examples/lbt.yaml").design("integrator", gain=0.4).gain
        0.4
        """
        request = design_request(method, options) if isinstance(method, str) else method
        with name_file(self.source):
            inputs = DesignInputs(
                plant=self.plant,
                truth=self.truth,
                atmosphere=self.atmosphere,
                sensor_gain=self.sensor_gain,
                defaults=dict(self.settings.design),
                size_nm=lambda entry, key: vibration_rms_nm(entry, self.settings, key),
            )
            design = request.build(inputs)
        said = design.assumptions
        if self.other_sensors and not design.other_sensors:
            said = (*said, f"the loop's own sensor is read alone, without {self.other_sensors}")
        return replace(design, configuration=self.text, assumptions=said)

    @property
    def other_sensors(self) -> str:
        """Names of the sensors and channels beside the loop's own, empty if there are none."""
        return ", ".join(self.hardware.suite.units[1:])

    @property
    def text(self) -> str:
        """What the file gives, as JSON; :func:`config_from_text` reads it."""
        return self.settings.model_dump_json(exclude_unset=True)

    def refuse_key(self, key: str, why: str) -> NoReturn:
        """Raise ConfigError for a key of the file, in the words after its name."""
        raise ConfigError(f"{self.source}: the key {key} {why}.", path=key)

    @property
    def end_to_end(self) -> EndToEndSetup:
        """The end-to-end simulation; ConfigError if the file does not describe one."""
        with name_file(self.source):
            return build_end_to_end_setup(self.settings, self.hardware, self.truth)


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read a YAML configuration file, check it and build its objects.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Config
        The configuration.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or a key is unknown, missing or
        has an impossible value; ``path`` on the error is that of the key.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> config.hardware.frame_rate_hz, config.plant.A.shape
    (800.0, (8, 8))
    """
    source = file_path(path, "a configuration")
    return build_config(validate_sections(FileSection, read_mapping(source), source), source)


def config_from_text(text: str, source: Path) -> Config:
    """Build the configuration of ``Config.text``, which came from a file."""
    raw = json.loads(text)
    return build_config(
        validate_sections(FileSection, raw, f"the configuration in {source}"), source
    )


def validate_sections(schema: type[Checked], raw: Mapping[str, Any], source: Path | str) -> Checked:
    """Check the mapping of a file against its schema, and return its sections."""
    try:
        return schema.model_validate(raw)
    except ValidationError as error:
        message, key = describe_error(error)
        raise ConfigError(f"{source}: {message}", path=key) from error


def read_mapping(source: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping."""
    try:
        text = read_bytes(source, FileError, most=_LARGEST_BYTES).decode("utf-8-sig")
    except FileError as error:
        raise ConfigError(str(error)) from error
    except UnicodeDecodeError as error:
        where = f"{error.reason} at byte {error.start}"
        raise ConfigError(f"{source} is not UTF-8 text: {where}.") from error
    try:
        raw = YAML(typ="safe", pure=True).load(text)
    except Exception as error:  # the parsers of YAML raise whatever they like
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or error_reason(error)
        raise ConfigError(f"{source} is not valid YAML{where}: {problem}.") from error
    if not isinstance(raw, dict):
        got = "nothing" if raw is None else f"a {type(raw).__name__}"
        raise ConfigError(f"{source} must hold sections, each with its keys; got {got}.")
    return raw


def build_config(settings: FileSection, source: Path) -> Config:
    """Build the objects that the settings of a file describe."""
    try:
        atmosphere = build_atmosphere(settings)
        noise_nm = measurement_noise_nm(settings)
        plant = build_plant(settings, atmosphere, noise_nm)
        truth = build_truth(settings, atmosphere, noise_nm, plant)
    except ProblemError as error:
        raise ConfigError(f"{source}: {error}", path=getattr(error, "path", "")) from error
    except ArithmeticError as error:
        raise ConfigError(
            f"{source}: some value is far from any telescope: {error}. Check the units."
        ) from error
    telescope = settings.telescope
    imaging = Imaging(
        diameter_m=None if telescope is None else telescope.diameter_m,
        obstruction=0.0 if telescope is None else telescope.obstruction,
        wavelength_um=settings.imaging.wavelength_um,
        other_modes=settings.imaging.other_modes_strehl,
    )
    return Config(
        settings=settings,
        plant=plant,
        truth=truth,
        imaging=imaging,
        atmosphere=atmosphere,
        noise_nm=noise_nm,
        sensor_gain=reference_gain(settings),
        source=source,
    )


def telescope_names() -> list[str]:
    """Return the names of the telescopes that have a template, in alphabetical order."""
    files = (_FILES / "telescopes").iterdir()
    return sorted(file.name.removesuffix(".yaml") for file in files)


def telescope_template(name: str) -> str:
    """Return a commented configuration of a telescope, with published numbers and their sources.

    Parameters
    ----------
    name : str
        ``elt``, ``gemini``, ``generic``, ``keck``, ``lbt`` or ``vlt``. All numbers of ``generic``
        are assumed.

    Returns
    -------
    str
        Text in YAML.

    Raises
    ------
    ProblemError
        If there is no such template.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> print(lbt.config.telescope_template("elt").splitlines()[8])
      diameter_m: 38.5                  # [1]
    """
    choice(name, "name", telescope_names())
    return (_FILES / "telescopes" / f"{name}.yaml").read_text(encoding="utf-8")


def example_files() -> dict[str, str]:
    """Return the texts of the examples of the documentation by the names of their files."""
    files = (_FILES / "examples").iterdir()
    return {file.name: file.read_text(encoding="utf-8") for file in files}
