"""All modes of a system in one file: the designs that control them, mode by mode."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from lbt_synth.design import Check, Design, IntegratorLaw, integrator
from lbt_synth.design.modal import MixedController, ModalFilters
from lbt_synth.design.modal.per_mode import name_modes
from lbt_synth.errors import ProblemError
from lbt_synth.interop.export_checks import require_exportable, require_modal
from lbt_synth.models import LoopHardware
from lbt_synth.validation import integer, number

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


@dataclass(frozen=True, slots=True, kw_only=True)
class AllModes:
    """The designs of a file, its modes, and how many of them come first and have a design."""

    parts: list[ModeDesign]
    own: int
    count: int

    def name_checks(self, part: ModeDesign, checks: Iterable[Check]) -> list[Check]:
        """Return checks of a part, named after its modes where there are others."""
        if len(part.modes) == self.own:
            return list(checks)
        modes = name_modes(np.array(part.modes))
        return [replace(check, name=f"{check.name} ({modes})") for check in checks]


def all_modes(
    design: ModalDesign,
    file: str,
    *,
    modes: int | None,
    other_gain: float | None,
    hardware: LoopHardware | None,
    modal: bool = True,
) -> AllModes:
    """Return the designs of a file, each certified; ``modal`` requires one of modes."""
    if hardware is not None and design.hardware is not None:
        raise ProblemError("hardware must be left out where a design has a loop; got both.")
    if isinstance(design, ModalFilters):
        design = design.start()
    if isinstance(design, MixedController):
        if other_gain is not None:
            raise ProblemError("other_gain goes with a design; here each mode has its own gain.")
        parts, own = _mode_designs(design, file, hardware), design.n_modes
        if not parts:
            raise ProblemError("at least one mode must have a gain above 0; all are 0.")
        for part in parts:
            require_exportable(part.design)
    else:
        require_exportable(design)
        modal = modal or other_gain is not None
        own = require_modal(design, file) if modal else len(design.controller.C)
        parts = [ModeDesign(design, tuple(range(own)))]
    count = own if modes is None else integer(modes, "modes", at_least=1)
    if count < own:
        raise ProblemError(f"modes must be at least {own}, those of the design; got {count}.")
    if other_gain is not None:
        if modes is None:
            raise ProblemError("other_gain needs the number of modes of the RTC: give modes.")
        if count == own:
            raise ProblemError(
                f"other_gain must be left out: the design has all {own} modes. Or give modes, the "
                "number of those of the RTC."
            )
        loop = parts[0].design.hardware
        assert loop is not None  # require_modal refuses a design without a loop
        others = integrator(loop.single_mode(), gain=number(other_gain, "other_gain", above=0))
        parts.append(ModeDesign(others, tuple(range(own, count))))
        own = count
    return AllModes(parts=parts, own=own, count=count)


def _mode_designs(
    control: MixedController, file: str, hardware: LoopHardware | None
) -> list[ModeDesign]:
    """Return the design of each mode; modes that get no command have none."""
    if control.reconstructor is not None:
        raise ProblemError("the RTC reconstructs modes itself; got a reconstructor.")
    loop = control.hardware or hardware
    if loop is None:
        raise ProblemError("hardware must be given where no filter has a loop; got None.")
    if control.filter is None:
        found = []
    elif isinstance(control.filter, ModalFilters):
        filtered, which = np.array(control.filtered), control.filter.which
        found = [
            ModeDesign(design, tuple(filtered[which == i].tolist()))
            for i, design in enumerate(control.filter.designs)
        ]
    elif isinstance(control.filter, Design):
        require_modal(control.filter, file)
        found = [ModeDesign(control.filter, tuple(control.filtered))]
    else:
        kind = type(control.filter).__name__
        raise ProblemError(f"the filter must be a certified design or ModalFilters; got {kind}.")
    laws: dict[tuple[float, float], list[int]] = {}
    for mode in np.setdiff1d(np.arange(control.n_modes), control.filtered):
        laws.setdefault((float(control.gains[mode]), float(control.leak[mode])), []).append(mode)
    single = loop.single_mode()
    for (gain, leak), modes in laws.items():
        if gain > 0:
            design = integrator(single, gain=gain, law=IntegratorLaw(leak=leak))
            found.append(ModeDesign(design, tuple(int(mode) for mode in modes)))
    return found
