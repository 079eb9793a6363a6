"""From a wish to what the page shows: pure functions, in the order in which results come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.linear import hinf_norm, largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.registry import default_method, design_title, method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.report.designs.report import require_compatible
from lbt_synth.report.designs.simulation import exact_spectrum
from lbt_synth.report.explore.knobs import (
    SHIFT,
    Knob,
    list_knobs,
    section_of,
    shift_range_hz,
)
from lbt_synth.report.figures.loops import frequency_grid
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact, facts, row_table
from lbt_synth.storage.tables import Table
from lbt_synth.studies import compare_in_truth, robustness_map
from lbt_synth.validation import ComplexArray, FloatArray

_POINTS, _NEAR_A_LINE = 240, 28  # frequencies of a curve: in all, and on each side of a line
_SHIFTS = 15
_SEGMENT = 2048  # frames of a segment of the spectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A design on the page: first its curves, then what it leaves; nan in an unstable loop."""

    frequency_hz: FloatArray  # (f,)
    error_nm: FloatArray | None  # (f,): norm of the estimation error; None without an estimate
    rejection: FloatArray  # (f,): norm from phase to residual
    noise_transfer: FloatArray  # (f,): norm from noise to residual
    spectrum_nm2_hz: FloatArray  # (f,): of the residual, sum over the axes
    broken: ComplexArray  # (q, f): loop gain of each measurement, the others closed
    poles: ComplexArray  # of the closed loop
    # residual [nm rms], Strehl ratio and modulus margin where the true lines are now
    left: tuple[float, float, float] | None = None
    shift_hz: FloatArray | None = None  # (s,): by which the true lines are moved from the start
    strehls: FloatArray | None = None  # (s,): Strehl ratio there, in [0, 1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exploration:
    """A configuration, designs to compare with, and what can be moved."""

    config: Config
    designs: Mapping[str, Design]
    knobs: tuple[Knob, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What a method and sliders give; the first of the designs on show is its own."""

    values: Mapping[str, float]  # of the knobs that were moved, by their keys
    config: Config
    request: DesignRequest
    shift_hz: float  # of the true lines
    design: Design
    shown: Mapping[str, Shown]
    is_whole: bool = False  # whether what the designs leave is that of this view

    @property
    def name(self) -> str:
        """Name of the design."""
        return next(iter(self.shown))


def explore(config: Config, designs: Mapping[str, Design]) -> Exploration:
    """Return what can be explored; ProblemError for a design that does not fit the loop."""
    for name, design in designs.items():
        require_compatible(name, design, config.hardware)
    return Exploration(config=config, designs=designs, knobs=list_knobs(config))


def moved_knobs(
    method: str, values: Mapping[str, float], knobs: Sequence[Knob]
) -> dict[Knob, float]:
    """Return the knobs that were moved and act on the designs of a method, with values in reach."""
    return {
        knob: min(max(float(values[knob.key]), knob.low), knob.high)
        for knob in knobs
        if knob.key in values and (knob.methods is None or method in knob.methods)
    }


def fulfil(
    name: str, values: Mapping[str, float], knobs: Sequence[Knob], config: Config
) -> tuple[Config, DesignRequest]:
    """Return the configuration and the request of a method whose knobs were moved.

    ConfigError where they do not fit.
    """
    method, moved = method_named(name), moved_knobs(name, values, knobs)
    content = config.settings.model_dump(exclude_unset=True)
    section = None if method.section is None else section_of(method, config)
    if section is not None and content.setdefault("design", {}).get(name) is None:
        content["design"][name] = section.model_dump(exclude_unset=True)  # made for its plant
    for knob, value in moved.items():
        if knob.edit is not None:
            knob.edit(config, content, value, value / knob.value if knob.value else 1.0)
    settings = validate_sections(FileSection, content, config.source)
    options = {
        knob.option: moved.get(knob, knob.value)
        for knob in knobs
        if knob.option and name in (knob.methods or ())
    }
    request = design_request(name, {**method.reference_options, **options})
    return build_config(settings, config.source), request


def quick_view(
    exploration: Exploration,
    method: str | None = None,
    values: Mapping[str, float] = MappingProxyType({}),
    before: View | None = None,
) -> View:
    """Design, and return the view with its curves; the view before lends what is not yet known."""
    name, knobs = method or default_method(), exploration.knobs
    config, request = fulfil(name, values, knobs, exploration.config)
    shifts = (v for knob, v in moved_knobs(name, values, knobs).items() if knob.key == SHIFT)
    design, label = config.design(request), request.method.label
    own = f"{label} by the sliders" if label in exploration.designs else label
    shown = {
        name: loop_curves(one, config) for name, one in {own: design, **exploration.designs}.items()
    }
    if before is not None:
        shown = {
            name: replace(one, left=last.left, shift_hz=last.shift_hz, strehls=last.strehls)
            for (name, one), last in zip(shown.items(), before.shown.values(), strict=True)
        }
    return View(
        values=values,
        config=config,
        request=request,
        shift_hz=next(shifts, 0.0),
        design=design,
        shown=shown,
    )


def loop_curves(design: Design, config: Config) -> Shown:
    """Return the curves of a design in the loop of a configuration."""
    hardware, truth = config.hardware, config.truth
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    density = {"points": _POINTS, "near": _NEAR_A_LINE}
    grid = frequency_grid(hardware.frame_rate_hz, truth.lines_hz, **density)
    n, m = hardware.modes, hardware.n_commands
    response = loop.system.frequency_response(grid)
    returned = response[:, n + m :, n:].diagonal(axis1=1, axis2=2).T
    stable, nothing = loop.is_stable, np.full(grid.size, np.nan)
    return Shown(
        frequency_hz=grid,
        error_nm=largest_singular_values(design.error_system(), grid)
        if design.is_estimator
        else None,
        rejection=spectral_norms(response[:, :n, :n]) if stable else nothing,
        noise_transfer=spectral_norms(response[:, :n, n:]) if stable else nothing,
        spectrum_nm2_hz=exact_spectrum(loop, truth, grid, _SEGMENT) if stable else nothing,
        broken=1 / returned - 1,
        poles=loop.system.poles,
    )


def whole_view(exploration: Exploration, view: View) -> View:
    """Return a view with what its designs leave."""
    designs = (view.design, *exploration.designs.values())
    shown = {
        name: complete(one, design, view, exploration.config)
        for (name, one), design in zip(view.shown.items(), designs, strict=True)
    }
    return replace(view, shown=shown, is_whole=True)


def complete(one: Shown, design: Design, view: View, start: Config) -> Shown:
    """Return a design with what it leaves if the true lines move from where they are at start."""
    hardware, config = view.config.hardware, view.config
    lines = {n: getattr(start.truth, n) for n in ("vibrations", "frequency_errors_hz")}
    truth = replace(config.truth, **lines)
    shifts = np.unique(np.append(np.linspace(*shift_range_hz(start), _SHIFTS), view.shift_hz))
    grid = robustness_map(
        design,
        truth,
        config.imaging,
        hardware=hardware,
        errors_hz=shifts,
        sensor_gains=[truth.sensor_gain],
    )
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    now = int(np.searchsorted(shifts, view.shift_hz))
    modulus = 1 / float(hinf_norm(loop.output_sensitivity())) if loop.is_stable else np.nan
    left = float(grid.residual_nm[0, 0, now]), float(grid.strehl[0, 0, now]), modulus
    return replace(one, left=left, shift_hz=shifts, strehls=grid.strehl[0, 0])


def explored_table(shown: Mapping[str, Shown]) -> Table:
    """Return what designs leave; an unstable loop has no numbers."""
    rows = [
        facts(
            design=fact(name, "design"),
            residual_nm=fact(one.left[0], "residual", unit="nm", format=".1f", missing="unstable"),
            strehl=fact(one.left[1], "Strehl ratio", unit="%", scale=100, format=".2f"),
            modulus=fact(one.left[2], "modulus margin", format=".3f"),
        )
        for name, one in shown.items()
        if one.left is not None
    ]
    return row_table("", rows)


def describe_moves(exploration: Exploration, view: View) -> str:
    """Return the sliders that were moved for a view, as people read them; empty without any."""
    moved = moved_knobs(view.request.method.name, view.values, exploration.knobs)
    return ", ".join(
        f"{knob.label} {value * knob.shown[1]:.4g} {knob.shown[0]}".rstrip()
        for knob, value in moved.items()
    )


def judge(view: View) -> str:
    """Return the verdict on the design of a view, in sentences."""
    compared = compare_in_truth({view.name: view.design}, view.config)
    own, *others = compared.rows
    passed = f"All {len(view.design.certificate.checks)} checks of its certificate passed."
    if not own.stable:
        return f"{view.name} is UNSTABLE in this loop. {passed}"
    hardware, gain = view.config.hardware, view.config.truth.sensor_gain
    margins = loop_margins(close_loop(hardware, view.design.controller, sensor_gain=gain))
    residual, strehl = nm_text(own.residual_nm, ".1f", unit="nm rms"), 100 * own.strehl
    sentences = [f"{view.name} leaves {residual}, Strehl ratio {strehl:.1f} %"]
    if compared.limit is not None:
        above = f"{own.above_limit_percent:.1f}"
        sentences[0] += f", {above} % above the least of any linear controller"
    best = min(others, key=lambda row: row.residual_nm, default=own)
    if best.residual_nm < own.residual_nm:
        least = nm_text(best.residual_nm, ".1f")
        sentences.append(f"the {design_title(best.method)} leaves {least} here")
    sentences.append(
        f"Margins: modulus {margins.modulus:.3g}, phase {margins.phase_deg:.3g} degrees"
    )
    sentences.append(f"it {margins.survival.removesuffix('.')}")
    sentences += [f"WARNING: {text.removesuffix('.')}" for text in margins.fragilities]
    sentences += compared.warnings[view.name]
    return ". ".join(text[0].upper() + text[1:] for text in sentences) + f". {passed}"
