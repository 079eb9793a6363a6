"""All modes of a system in one file: the designs that control them, mode by mode."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from lbt_synth.design import Design, IntegratorLaw, integrator
from lbt_synth.design.modal import MixedController, ModalFilters
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import CertificateError, ProblemError
from lbt_synth.validation import integer, number, require_instance

ModalDesign: TypeAlias = Design | MixedController | ModalFilters


class ModeDesign(NamedTuple):
    """A design, and the modes that it controls; one of a single mode controls each of them."""

    design: Design
    modes: tuple[int, ...]

    @property
    def copies(self) -> list[tuple[int, ...]]:
        """The modes of each copy of the controller."""
        single = len(self.design.controller.C) == 1
        return [(mode,) for mode in self.modes] if single else [self.modes]


def require_exportable(design: Design, *, reads_others: bool = False) -> None:
    """Refuse a design that is not certified, or that reads sensors which a target does not know."""
    require_instance(design, Design)
    if not design.certificate.passed:
        failed = tuple(check.name for check in design.certificate.checks if not check.passed)
        raise CertificateError(
            f"only a certified design is exported; this one failed: {'; '.join(failed)}.",
            failed=failed,
        )
    if design.other_sensors and not reads_others:
        raise ProblemError(
            f"this design reads {', '.join(design.other_sensors)} beside the loop's own sensor, "
            "each when it is due; what this target loads has one matrix, for a loop of one sensor. "
            "Export it to C."
        )


def require_modal(design: Design) -> int:
    """Return the number of modes of a design that measures, with a gain each, and moves modes."""
    hardware = require_hardware(design, "an export of modes")
    sensor, identity = hardware.sensor, np.eye(hardware.modes)
    own = "the RTC reconstructs modes and projects them on actuators itself. Design for the modes."
    if sensor.shape != identity.shape or np.any(sensor != np.diag(np.diag(sensor))):
        raise ProblemError(f"sensor_matrix must be diagonal, a gain for each mode: {own}")
    if not np.array_equal(hardware.influence, identity):
        raise ProblemError(f"influence_matrix must be the identity: {own}")
    return hardware.modes


def mode_designs(
    design: ModalDesign,
    target: str,
    *,
    modes: int | None,
    other_gain: float | None,
    modal: bool,
    mixed: bool,
    reads_others: bool,
) -> tuple[list[ModeDesign], int]:
    """Return the designs of a file, each certified, and the number of its modes."""
    if isinstance(design, ModalFilters):
        count = design.n_modes
        design = MixedController(filter=design, gains=np.zeros(count), filtered=range(count))
    if isinstance(design, MixedController):
        if not mixed:
            raise ProblemError(
                f"target {target} holds one design, for the first modes, and at most one gain for "
                f"all others; got {type(design).__name__}. Give a design."
            )
        if other_gain is not None:
            raise ProblemError("other_gain goes with a design; here each mode has its own gain.")
        parts, controlled = _mode_designs(design), design.n_modes
        for part in parts:
            require_exportable(part.design)
    else:
        require_exportable(design, reads_others=reads_others)
        if design.other_sensors and (modes is not None or other_gain is not None):
            raise ProblemError(
                "modes and other_gain go with a design of one sensor; got one of several. Leave "
                "them out."
            )
        several = other_gain is not None or (mixed and modal)
        controlled = require_modal(design) if several else len(design.controller.C)
        parts = [ModeDesign(design, tuple(range(controlled)))]
    count = controlled if modes is None else integer(modes, "modes", at_least=1)
    if count < controlled:
        raise ProblemError(
            f"modes must be at least {controlled}, those of the design; got {count}."
        )
    if other_gain is not None:
        if count == controlled:
            raise ProblemError(
                f"other_gain needs modes, the number of those of the RTC, above the {controlled} "
                "of the design. Give modes, or leave other_gain out."
            )
        single = require_hardware(parts[0].design, "an export of modes").single_mode()
        others = integrator(single, gain=number(other_gain, "other_gain", above=0))
        parts.append(ModeDesign(others, tuple(range(controlled, count))))
    return parts, count


def _mode_designs(control: MixedController) -> list[ModeDesign]:
    """Return the design of each mode; modes that get no command have none."""
    loop, kind = control.hardware, type(control.filter).__name__
    if loop is None:
        raise ProblemError(f"the filter must be a certified design or ModalFilters; got {kind}.")
    designs: list[ModeDesign] = []
    if hasattr(control.filter, "designs"):
        filtered, which = np.array(control.filtered), control.filter.which
        designs += [
            ModeDesign(design, tuple(filtered[which == i].tolist()))
            for i, design in enumerate(control.filter.designs)
        ]
    else:
        require_modal(control.filter)
        designs.append(ModeDesign(control.filter, tuple(control.filtered)))
    laws: dict[tuple[float, float], list[int]] = {}
    for mode in np.setdiff1d(np.arange(control.n_modes), control.filtered).tolist():
        laws.setdefault((float(control.gains[mode]), float(control.leak[mode])), []).append(mode)
    single = loop.single_mode()
    for (gain, leak), modes in laws.items():
        if gain > 0:
            law = integrator(single, gain=gain, law=IntegratorLaw(leak=leak))
            designs.append(ModeDesign(law, tuple(modes)))
    return designs
