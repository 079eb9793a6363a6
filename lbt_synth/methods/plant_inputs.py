"""A plant alone as what a method designs for, as a study or a record has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import design_request

if TYPE_CHECKING:
    from lbt_synth.design import Design
    from lbt_synth.models import LoopHardware, TipTiltPlant, Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantInputs:
    """A plant whose truth is not known, with defaults of the options."""

    plant: TipTiltPlant
    design_defaults: Mapping[str, Any] = field(default_factory=dict)
    atmosphere: None = None
    sensor_gain: float = 1.0

    @property
    def hardware(self) -> LoopHardware:
        """The loop."""
        return self.plant.hardware

    @property
    def truth(self) -> Truth:
        """Raise ProblemError: a plant is a model."""
        raise ProblemError("this method needs a truth; got a plant alone. Try a configuration.")

    def method_section(self, name: str) -> Any:
        """Return None: there is no configuration."""

    def size_nm(self, entry: Any, key: str) -> float:
        """Return the size of an entry, which must give it in nm."""
        if entry.rms_nm is None:
            raise ProblemError(f"{key}: expected rms_nm, as a plant knows no telescope.")
        return float(entry.rms_nm)


def reference_design(name: str, plant: TipTiltPlant, options: Mapping[str, Any]) -> Design:
    """Design a method for a plant as studies do that compare with it; it takes what it knows."""
    method = method_named(name)
    own = {key: value for key, value in options.items() if key in method.options.model_fields}
    reference = {} if method.reference is None else method.reference[1]
    return design_request(name, {**reference, **own}).build(PlantInputs(plant=plant))
