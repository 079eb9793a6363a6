"""A filter of several sensors in an end-to-end simulation, whose only optics are the pyramid's.

The readings of accelerometers are computed from the motions that shake the simulated telescope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.loop.simulation.disturbances import draw_parts
from lbt_synth.loop.simulation.failing_sensors import draw_others
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.validation import FloatArray


@dataclass(kw_only=True, eq=False)
class AccompaniedFilter:
    """A filter of several sensors to step with the pyramid alone: it has the other readings."""

    controller: Controller
    others: FloatArray  # readings of the other sensors in each frame, (frames, q)
    hardware: LoopHardware  # that the filter is designed for

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Return to the first frame, with all states zero."""
        self._frame, self._running = 0, self.controller.start()

    def step(self, y: FloatArray) -> FloatArray:
        """Take the measurements of the loop's own sensor in the next frame, return the commands."""
        if self._frame >= len(self.others):
            raise ProblemError(
                f"the other sensors have readings for {len(self.others)} frames; a frame more was "
                "asked for. Give the set-up that makes the controller the frames of the run."
            )
        measured = np.concatenate([y, self.others[self._frame]])
        self._frame += 1
        return self._running.step(measured)


def unread_sensors(design: Design) -> tuple[str, ...]:
    """Return the sensors that an end-to-end simulation does not have: further wavefront sensors."""
    hardware = design.hardware
    return () if hardware is None else tuple(s.name for s in hardware.suite.wavefront)


def accompany_filter(
    design: Design, shaken: Truth, *, frames: int, settle_frames: int, seed: int
) -> AccompaniedFilter:
    """Return a filter of tip and tilt with the readings of its accelerometers in a run.

    Its fall-back runs where it has wavefront sensors beside the pyramid. ``shaken`` has the
    vibrations of the run, and how channels move with them; frames and seed are those of
    :func:`run_end_to_end`, whose motions the readings follow.
    """
    hardware = require_hardware(design, "an end-to-end simulation")
    channels = hardware.suite.channels
    if (hardware.n_measurements, hardware.n_commands) != (2, 2):
        raise DimensionError(
            "the filter must map two measurements of the loop's own sensor, tip and tilt, to two "
            f"commands; got {hardware.n_measurements} to {hardware.n_commands}."
        )
    if channels and not any(shaken.motions):
        raise ProblemError(
            f"no vibration of the simulation moves a channel of the design ({', '.join(channels)})."
            " Give sensors, and accelerometers of each vibration, in the configuration."
        )
    missing = frozenset(unread_sensors(design))
    size = {"frames": settle_frames + frames, "cases": 1, "zero_frame": settle_frames}
    rng = np.random.default_rng(seed)
    _, lines = draw_parts(shaken, hardware, rng=rng, oscillators=True, **size)
    (own_rng,) = rng.spawn(1)
    others = draw_others(shaken, hardware, lines, own_rng, **size)
    return AccompaniedFilter(
        controller=design.controllers[missing], others=others[0], hardware=hardware
    )
