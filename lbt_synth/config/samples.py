"""Samples of a configuration that differ only by numbers that its builders take as arrays.

What a builder reads of a section in the ordinary way must be the same for all samples that are
evaluated together. A number that it takes for each sample is read through ``per_sample``: of an
ordinary section it is the number, of a section of samples an array. Builders thus declare what
they depend on by reading it, and :class:`Reads` says which numbers of a configuration may differ.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, cast

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from lbt_synth.config.schema import FileSection
from lbt_synth.config.section import Section
from lbt_synth.validation import BoolArray, FloatArray

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


def view_samples(
    settings: FileSection, reads: Reads, values: Mapping[Keys, FloatArray] | None = None
) -> FileSection:
    """Return the settings of samples with arrays (b,) at some keys; it records what is read."""
    return cast(FileSection, SampleView(settings, reads, values or {}))


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
