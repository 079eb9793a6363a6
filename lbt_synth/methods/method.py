"""What a method of synthesis is: its name, its options, and what it does with a design."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

from lbt_synth.errors import suggest_word

if TYPE_CHECKING:
    from lbt_synth.design.result import Design
    from lbt_synth.models import Atmosphere, TipTiltPlant, Truth


class Section(BaseModel):
    """Options or a section of a file: strict types, no unknown keys, read-only."""

    model_config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, frozen=True, defer_build=True
    )

    @model_validator(mode="before")
    @classmethod
    def _know_keys(cls, content: Any) -> Any:
        """Refuse a key that the section does not have, and name the one that was meant."""
        names = sorted(field.alias or name for name, field in cls.model_fields.items())
        closed = isinstance(content, dict) and cls.model_config["extra"] == "forbid"
        for word in content if closed else ():
            if word not in names:
                advice = {"word": word, "advice": suggest_word(str(word), names)}
                raise PydanticCustomError("unknown_key", "unknown key", advice)
        return content

    def arguments(self) -> dict[str, Any]:
        """Return the options as arguments of the function that designs."""
        return self.model_dump()


def rule(mistake: Callable[[Any], str]) -> Any:
    """Return a rule of a section, from a function that says what is wrong, or nothing."""

    def check(section: Any) -> Any:
        if text := mistake(section):
            raise ValueError(text)
        return section

    return model_validator(mode="after")(check)


def exactly_one(*names: str) -> Any:
    """Return the rule that a section has exactly one of some keys."""

    def mistake(section: Any) -> str:
        used = [name for name in names if getattr(section, name) is not None]
        text = f"expected exactly one of {', '.join(names)}; got {' and '.join(used) or 'none'}"
        return "" if len(used) == 1 else text

    return rule(mistake)


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignInputs:
    """What a method designs for: a plant, and what a configuration or a record says beside it."""

    plant: TipTiltPlant  # with all sensors of the loop
    truth: Truth | None = None  # what the loop really meets, where it is known
    atmosphere: Atmosphere | None = None
    sensor_gain: float = 1.0  # that the design assumes; real gains are given beside it
    # the section ``design`` of a configuration: options of any method, and sections by method
    defaults: Mapping[str, Any] = field(default_factory=dict)
    # from an entry with a size and its key to the size [nm rms wavefront]
    size_nm: Callable[[Any, str], float] = lambda entry, key: float(entry.rms_nm)
    predict: Callable[[], Design] | None = None  # the design of the record, where there is one


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A method of synthesis, whole: all that the package knows of it stands here."""

    name: str  # as ``lbt-synth design --method`` and ``design:`` in a study call it
    title: str  # in a sentence ("Kalman filter")
    label: str  # in the legend of a figure ("Kalman")
    options: type[Section]  # each with its description, limits and default
    build: Callable[[DesignInputs, Any], Design]  # a certified design
    design: str  # the class of its designs, "module:class", with its arrays, claims and checks
    section: type[Section] | None = None  # ``design.<name>`` of a configuration
    # from a plant alone to a section with defaults; None if it takes a configuration
    plant_section: Callable[[TipTiltPlant], Section] | None = None
    exclusive: frozenset[str] = frozenset()  # options of which at most one is given
    configurable: frozenset[str] = frozenset()  # those whose default a configuration can give
    estimator: bool = True  # whether the design depends on the vibrations of the plant
    of_record: bool = False  # whether it takes a record, beside the plant identified from it
    batched: bool = False  # whether a study designs it for many samples at once
    slow: bool = False  # whether it takes many seconds: an automatic choice leaves it out
    reference_rank: int | None = None  # among those that studies compare designs with
    reference_options: Mapping[str, Any] = field(default_factory=dict)  # when it is compared
    # further ones where it stands for what a telescope would run, beside the limits
    compared_options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> type[Design]:
        """The class of its designs, imported."""
        kind: type[Design] = resolve_name(self.design)
        return kind

    @property
    def needs_options(self) -> bool:
        """Whether some option has no default."""
        return any(option.is_required() for option in self.options.model_fields.values())
