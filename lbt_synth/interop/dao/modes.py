"""All modes of a system for one matrix: the designs that control them, mode by mode."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lbt_synth.design import Design, IntegratorLaw, integrator, kalman
from lbt_synth.design.modal import MixedController, ModalFilters
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.models import LoopHardware, tip_tilt_plant
from lbt_synth.validation import require_instance

_SAME = 1e-6  # relative difference of a filter designed alone from that of the batch


class ModeDesign(NamedTuple):
    """A design, and the modes whose columns it makes; of one mode it makes all of them."""

    design: Design
    modes: tuple[int, ...]


def mode_designs(
    control: MixedController | ModalFilters, hardware: LoopHardware | None
) -> list[ModeDesign]:
    """Return the design of each mode; modes that get no command have none."""
    if isinstance(control, ModalFilters):
        return _filter_designs(control, tuple(range(control.n_modes)))
    require_instance(control, MixedController)
    if control.reconstructor is not None:
        raise ProblemError("the RTC reconstructs modes itself; got a reconstructor.")
    loop = control.hardware or hardware
    if loop is None:
        raise ProblemError("hardware must be given where no filter has a loop; got None.")
    if control.filter is None:
        found = []
    elif isinstance(control.filter, ModalFilters):
        found = _filter_designs(control.filter, tuple(control.filtered))
    elif isinstance(control.filter, Design):
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


def _filter_designs(filters: ModalFilters, modes: tuple[int, ...]) -> list[ModeDesign]:
    """Design each filter alone; it is that of the batch, and has a certificate of its own."""
    found = []
    for index, mode in enumerate(modes):
        lines = [replace(line, direction=(1.0,)) for line in filters.vibrations[index]]
        design = kalman(
            tip_tilt_plant(
                frame_rate_hz=filters.turbulence.frame_rate_hz,
                turbulence=filters.turbulence.model(index),
                noise_nm=filters.noise_nm[index],
                vibrations=lines or None,
                delay_frames=filters.delay_frames,
                sensor_gain=float(filters.sensor_gain[index]),
                modes=1,
                mirror=filters.mirror,
            )
        )
        frequency = np.linspace(0.05, 0.45, 9) / filters.dt_s
        own, alone = (
            c.to_statespace().frequency_response(frequency)
            for c in (filters.controller(index), design.controller)
        )
        apart = float(np.max(np.abs(own - alone)) / np.max(np.abs(own)))
        if not apart < _SAME:
            raise NumericalError(
                f"the filter of mode {mode + 1} must be that of its models; it is {apart:.2g} off.",
                residual=apart,
            )
        found.append(ModeDesign(design, (mode,)))
    return found
