"""Samples of a configuration that differ only by numbers that its builders take as arrays.

What a builder reads of a section in the ordinary way must be the same for all samples that are
evaluated together. A number that it takes for each sample is read through ``per_sample``: of an
ordinary section it is the number, of a section of samples an array. Builders thus declare what
they depend on by reading it, and :class:`Reads` says which numbers of a configuration may differ.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, cast

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from lbt_synth.config.schema import FileSection
from lbt_synth.config.section import Section
from lbt_synth.errors import ConfigError
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray

_KEY = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)((?:\[[0-9]{1,6}\])*)")
Keys = tuple[str | int, ...]  # the path of a number, such as ("truth", "vibrations", 0, "rms_nm")


@dataclass(frozen=True, slots=True)
class Reads:
    """What builders have read of a configuration, by its keys."""

    per_sample: set[Keys] = field(default_factory=set)
    shared: set[Keys] = field(default_factory=set)  # or the keys of a whole section or list

    def take_arrays_at(self, keys: Keys) -> bool:
        """Whether the builders read a number, and every one takes it for each sample."""
        return keys in self.per_sample and not any(
            keys[: length + 1] in self.shared for length in range(len(keys))
        )


class SampleView:
    """A section of many samples, which records what builders read of it."""

    def __init__(
        self,
        section: Section,
        reads: Reads,
        values: Mapping[Keys, FloatArray],
        keys: Keys = (),
        per_sample: bool = False,
    ) -> None:
        self._section, self._reads, self._values = section, reads, values
        self._keys, self._per_sample = keys, per_sample

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return type(self._section)

    @property
    def per_sample(self) -> SampleView:
        """The same section, each of whose numbers that differ is an array."""
        return SampleView(self._section, self._reads, self._values, self._keys, per_sample=True)

    def require_one_value(self) -> None:
        """Record that the numbers of this section must not differ."""
        self._reads.shared.add(self._keys)

    def model_dump(self, *, exclude: Collection[str] = ()) -> dict[str, Any]:
        """Read all keys of this section."""
        return {n: getattr(self, n) for n in type(self._section).model_fields if n not in exclude}

    def __getattr__(self, name: str) -> Any:
        found = getattr(type(self._section), name, None)
        if isinstance(found, property) and found.fget is not None:
            return found.fget(self)
        return self._read(getattr(self._section, name), (*self._keys, name))

    def _read(self, value: Any, keys: Keys) -> Any:
        if isinstance(value, Section):
            return SampleView(value, self._reads, self._values, keys, self._per_sample)
        if isinstance(value, list):
            if any(isinstance(entry, Section) for entry in value):
                return [self._read(entry, (*keys, i)) for i, entry in enumerate(value)]
        elif self._per_sample:
            self._reads.per_sample.add(keys)
            return self._values.get(keys, value)
        self._reads.shared.add(keys)
        return value


def accepted_by_schema(settings: FileSection, keys: Keys, values: FloatArray) -> BoolArray:
    """Return which values (b,) the schema accepts for a number of a section."""
    here: Any = settings
    for key in keys[:-1]:
        here = here[key] if isinstance(key, int) else getattr(here, key)
    section: type[Section] = type(here)
    accepted = np.ones(len(values), dtype=np.bool_)
    try:
        _list_adapter(section, str(keys[-1])).validate_python(values.tolist())
    except ValidationError as error:
        accepted[[int(entry["loc"][0]) for entry in error.errors(include_url=False)]] = False
    return accepted


@lru_cache(maxsize=64)
def _list_adapter(section: type[Section], name: str) -> TypeAdapter[list[Any]]:
    """Return the check of a list of values of one key."""
    key = section.model_fields[name]
    kind: Any = Annotated[(key.annotation, *key.metadata)] if key.metadata else key.annotation
    rules = section.model_config
    config = ConfigDict(strict=rules["strict"], allow_inf_nan=rules["allow_inf_nan"])
    return TypeAdapter(list[kind], config=config)


@lru_cache(maxsize=256)
def parse_path(path: str) -> Keys:
    """Parse a path into its keys."""
    keys: list[str | int] = []
    for word in path.split("."):
        match = _KEY.fullmatch(word)
        if match is None:
            raise ConfigError(
                f"{path!r} is no path in a configuration; expected one such as "
                "truth.vibrations[0].frequency_hz."
            )
        keys += [match[1], *map(int, re.findall(r"[0-9]+", match[2]))]
    return tuple(keys)


def find_number(content: Mapping[str, Any], path: str) -> float:
    """Return the number to which a path leads; refuse a path that leads to none."""
    here: Any = content
    parent: Any = {}
    walked = ""
    for key in parse_path(path):
        place = walked or "the configuration"
        listed = isinstance(key, int)
        if not isinstance(here, list if listed else dict):
            says = "is no list" if listed else "has no keys"
            raise ConfigError(f"{path}: {place} {says}; {_describe(here)}.")
        if isinstance(key, int) and key >= len(here):
            raise ConfigError(
                f"{path}: {place} has {count_text(len(here), 'entry', 'entries')}, "
                f"counted from 0; got [{key}]."
            )
        if isinstance(key, str) and key not in here:
            close = difflib.get_close_matches(key, list(here), n=1, cutoff=0.6)
            hint = f"did you mean {close[0]}? " if close else ""
            raise ConfigError(
                f"{path}: {place} has no {key}; {hint}there are {', '.join(sorted(here))}."
            )
        walked += f"[{key}]" if listed else f".{key}" if walked else str(key)
        parent = here
        here = parent[key]
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
    is_integer = isinstance(whole[keys[-1]], int) and value.is_integer()
    here[keys[-1]] = int(value) if is_integer else value
