"""What the page asks for: a method and the sliders that were moved, as a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.report.explore.edits import section_content, section_of
from lbt_synth.report.explore.knobs import SHIFT, Knob


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """A method of synthesis, and the values of the knobs that were moved, by their keys."""

    method: str
    values: Mapping[str, float] = field(default_factory=dict)

    def move(self, knobs: Sequence[Knob]) -> dict[Knob, float]:
        """Return the knobs that it moves and that act on its design, with values in reach."""
        return {
            knob: min(max(float(self.values[knob.key]), knob.low), knob.high)
            for knob in knobs
            if knob.key in self.values and (knob.methods is None or self.method in knob.methods)
        }

    def shift_hz(self, knobs: Sequence[Knob]) -> float:
        """Return by how much it moves the true lines [Hz]."""
        return next((v for knob, v in self.move(knobs).items() if knob.key == SHIFT), 0.0)


def fulfil(wish: Wish, knobs: Sequence[Knob], config: Config) -> tuple[Config, DesignRequest]:
    """Return the configuration and the request of a wish; ConfigError where they do not fit."""
    method, moved = method_named(wish.method), wish.move(knobs)
    content = config.settings.model_dump(exclude_unset=True)
    if method.section is not None and section_of(method, config) is not None:
        section_content(method, config, content)
    for knob, value in moved.items():
        if knob.edit is not None:
            knob.edit(config, content, value)
    settings = validate_sections(FileSection, content, config.source)
    options = {
        knob.option: moved.get(knob, knob.value)
        for knob in knobs
        if knob.option and wish.method in (knob.methods or ())
    }
    request = design_request(wish.method, {**method.reference_options, **options})
    return build_config(settings, config.source), request
