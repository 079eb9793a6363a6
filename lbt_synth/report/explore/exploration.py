"""From a wish to what the page shows: pure functions, in the order in which results come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.design.certificate import Certificate
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.registry import default_method, design_title, method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.report.designs.assessment import require_compatible
from lbt_synth.report.explore.edits import section_content, section_of
from lbt_synth.report.explore.evaluation import loop_curves, performance
from lbt_synth.report.explore.knobs import SHIFT, Knob, list_knobs
from lbt_synth.report.explore.panels import Shown
from lbt_synth.report.number_text import fixed_text, number_text
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies import compare_in_truth


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exploration:
    """A configuration, designs to compare with, and what can be moved."""

    config: Config
    designs: Mapping[str, Design]
    knobs: tuple[Knob, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What a wish gives; the first of the designs on show is its own."""

    wish: Wish
    config: Config
    request: DesignRequest
    shift_hz: float  # of the true lines
    design: Design
    shown: Mapping[str, Shown]
    is_whole: bool = False  # Whether what the designs leave is that of this view

    @property
    def name(self) -> str:
        """Name of the design."""
        return next(iter(self.shown))

    @property
    def lines_hz(self) -> list[float]:
        """Frequencies of the true lines [Hz]."""
        return self.config.truth.lines_hz


def explore(config: Config, designs: Mapping[str, Design]) -> Exploration:
    """Return what can be explored; ProblemError for a design that does not fit the loop."""
    for name, design in designs.items():
        require_compatible(name, design, config.hardware)
    return Exploration(config=config, designs=designs, knobs=list_knobs(config))


def first_wish() -> Wish:
    """Return the wish that a page opens with."""
    return Wish(method=default_method())


def quick_view(exploration: Exploration, wish: Wish, before: View | None = None) -> View:
    """Design, and return the view with its curves; the view before lends what is not yet known."""
    config, request = fulfil(wish, exploration.knobs, exploration.config)
    design = config.design(request)
    label = request.method.label
    own = f"{label} by the sliders" if label in exploration.designs else label
    lent = [one.performance for one in before.shown.values()] if before else []
    shown = {
        name: Shown(
            curves=loop_curves(one, config), performance=lent[place] if place < len(lent) else None
        )
        for place, (name, one) in enumerate({own: design, **exploration.designs}.items())
    }
    return View(
        wish=wish,
        config=config,
        request=request,
        shift_hz=wish.shift_hz(exploration.knobs),
        design=design,
        shown=shown,
    )


def whole_view(exploration: Exploration, view: View) -> View:
    """Return a view with what its designs leave."""
    designs = (view.design, *exploration.designs.values())
    shown = {
        name: replace(
            one,
            performance=performance(name, design, view.config, exploration.config, view.shift_hz),
        )
        for (name, one), design in zip(view.shown.items(), designs, strict=True)
    }
    return replace(view, shown=shown, is_whole=True)


def describe_moves(exploration: Exploration, wish: Wish) -> str:
    """Return the sliders that a wish moved, as people read them; empty without any."""
    return ", ".join(
        f"{knob.label} {number_text(value * knob.shown[1])} {knob.shown[0]}".rstrip()
        for knob, value in wish.move(exploration.knobs).items()
    )


def judge(view: View) -> str:
    """Return the verdict on the design of a view, in sentences."""
    found = compare_in_truth({view.name: view.design}, view.config)
    own, *others = found.rows
    passed = _certificate_text(view.design.certificate)
    if not own.stable:
        return f"{view.name} is UNSTABLE in this loop. {passed}"
    loop = close_loop(
        view.config.hardware, view.design.controller, sensor_gain=view.config.truth.sensor_gain
    )
    margins = loop_margins(loop)
    parts = [
        f"{view.name} leaves {nm_text(own.residual_nm, '.1f', unit='nm rms')}, Strehl ratio "
        f"{fixed_text(100 * own.strehl, 1)} %"
    ]
    if found.limit is not None:
        parts.append(
            f"{fixed_text(own.above_limit_percent, 1)} % above the least of any linear controller"
        )
    sentences = [", ".join(parts)]
    better = [row for row in others if row.residual_nm < own.residual_nm]
    if better:
        best = min(better, key=lambda row: row.residual_nm)
        sentences.append(
            f"the {design_title(best.method)} leaves {nm_text(best.residual_nm, '.1f')} here"
        )
    sentences.append(
        f"Margins: modulus {number_text(margins.modulus, 3)}, phase "
        f"{number_text(margins.phase_deg, 3)} degrees, delay "
        f"{number_text(margins.delay_frames, 3)} frames, sensor gain times "
        f"{number_text(margins.gain_low, 3)} to {number_text(margins.gain_high, 3)}"
    )
    sentences += found.warnings[view.name]
    return ". ".join(text[0].upper() + text[1:] for text in sentences) + f". {passed}"


def _certificate_text(certificate: Certificate) -> str:
    return f"All {len(certificate.checks)} checks of its certificate passed."
