"""The real closed loop of one mode, on which terms and demands are evaluated exactly."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import ClosedLoop, close_loop, youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import tapped_mirror
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SingleModeLoop:
    """A controller of one mode in its loop, at any sensor gain."""

    hardware: LoopHardware
    controller: Controller
    _loops: dict[float, ClosedLoop] = field(default_factory=dict)

    def at(self, sensor_gain: float) -> ClosedLoop:
        """Return the loop at a sensor gain."""
        if sensor_gain not in self._loops:
            loop = close_loop(self.hardware, self.controller, sensor_gain=sensor_gain)
            self._loops[sensor_gain] = loop
        return self._loops[sensor_gain]

    @property
    def sensitivity(self) -> StateSpace:
        """S at unit sensor gain."""
        return self.at(1.0).output_sensitivity()

    @property
    def parameter(self) -> StateSpace:
        """The Youla parameter: from the noise to the command at unit sensor gain."""
        commanding, modes = self.at(1.0).commanding(), self.hardware.modes
        return replace(commanding, B=commanding.B[:, modes:], D=commanding.D[:, modes:])

    @property
    def complementary(self) -> StateSpace:
        """``T = 1 - S`` at unit sensor gain."""
        s = self.sensitivity
        return replace(s, C=-s.C, D=1 - s.D)


def mode_loop(hardware: LoopHardware, parameter: Controller) -> SingleModeLoop:
    """Close the loop of one mode around its Youla parameter."""
    single = mode_hardware(hardware)
    return SingleModeLoop(hardware=single, controller=youla_controller(single, parameter))


def mode_hardware(hardware: LoopHardware) -> LoopHardware:
    """Return the hardware of one mode, with unit sensor and mirror."""
    rate, delay = hardware.frame_rate_hz, hardware.delay_frames
    return LoopHardware(frame_rate_hz=rate, delay_frames=delay, modes=1, mirror=hardware.mirror)


def append_taps(system: StateSpace, taps: FloatArray) -> StateSpace:
    """Return a system of one output followed by ``taps[0] + taps[1] z^-1 + ...``."""
    late = tapped_mirror(taps)
    entry, none = late.B[:, None], np.zeros((system.n_states, late.n_states))
    return StateSpace(
        A=np.block([[system.A, none], [entry @ system.C, late.A]]),
        B=np.vstack([system.B, entry @ system.D]),
        C=np.hstack([late.D * system.C, late.C[None]]),
        D=late.D * system.D,
        dt_s=system.dt_s,
    )
