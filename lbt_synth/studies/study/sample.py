"""One sample of a study: its configuration, its real loop and its real disturbances."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, cast

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.samples import Keys
from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ConfigError, refuse_config
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Study
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
    """Parse a path into its keys.

    Examples
    --------
    >>> from lbt_synth.studies.study.sample import parse_path
    >>> parse_path("truth.vibrations[0].frequency_hz")
    ('truth', 'vibrations', 0, 'frequency_hz')
    """
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
                    f"{path}: {place} has {len(here)} entr{'y' if len(here) == 1 else 'ies'}, "
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
