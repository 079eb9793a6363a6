"""What a method of synthesis is: its name, its options, and what it does with a design."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from lbt_synth.methods.section import Section

if TYPE_CHECKING:
    from lbt_synth.design.record import DesignRecord
    from lbt_synth.design.result import Design
    from lbt_synth.models import Atmosphere, LoopHardware, TipTiltPlant, Truth
    from lbt_synth.validation import FloatArray


class DesignInputs(Protocol):
    """What a method designs for: a configuration, or the system identified from a record."""

    @property
    def plant(self) -> TipTiltPlant:
        """Plant of the design."""

    @property
    def hardware(self) -> LoopHardware:
        """The loop."""

    @property
    def truth(self) -> Truth:
        """What the loop really meets."""

    @property
    def atmosphere(self) -> Atmosphere | None:
        """Turbulence and telescope, where they are known."""

    @property
    def sensor_gain(self) -> float:
        """Sensor gain that the design assumes; real gains are given beside it."""

    @property
    def design_defaults(self) -> Mapping[str, Any]:
        """Options of any method that the configuration gives, by name."""

    def method_section(self, name: str) -> Any:
        """Return the section ``design.<name>``, None where the configuration has none."""

    def size_nm(self, entry: Any, key: str) -> float:
        """Return the size of an entry with ``rms_nm`` or ``rms_mas`` [nm rms wavefront]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RowTable:
    """A table that ``show`` prints: rows are dataclasses of columns."""

    key: str  # in JSON
    title: str
    rows: Sequence[Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """What ``show`` says of a design beyond what it says of every design."""

    facts: Any  # a dataclass of columns; what is None is not printed
    tables: Sequence[RowTable] = ()
    notes: Sequence[str] = ()
    matrices: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A method of synthesis, whole: all that the package knows of it stands here."""

    name: str  # of ``--method``, and of ``design:`` in a study
    title: str  # in a sentence: "Kalman filter"
    label: str  # in a figure: "Kalman"
    options: type[Section]  # each field with its help, unit, limits and default
    build: Callable[[DesignInputs, Any], Design]
    pack: Callable[[Any], DesignRecord]  # what a gain file holds beyond the controller
    unpack: Callable[[DesignRecord], Design]
    describe: Callable[[Any], Description]
    design_names: tuple[str, ...] = ()  # ``Design.method`` of its designs, where not ``name``
    section: type[Section] | None = None  # of the configuration, as ``design.<name>``
    exclusive: frozenset[str] = frozenset()  # at most one of these options is given
    configurable: frozenset[str] = frozenset()  # options that ``design`` gives a default
    estimator: bool = True  # designed for the model of the plant, vibrations included
    batched: bool = False  # of single axes: designed for many samples at once
    # rank among the references that studies compare designs with, and their options
    reference: tuple[int, Mapping[str, Any]] | None = None

    @property
    def needs_options(self) -> bool:
        """Whether some option has no default."""
        return any(option.is_required() for option in self.options.model_fields.values())
