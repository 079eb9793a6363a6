"""The real closed loop of one mode, on which terms and demands are evaluated exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import ClosedLoop, close_loop, youla_controller
from lbt_synth.models import LoopHardware
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
            self._loops[sensor_gain] = close_loop(
                self.hardware, self.controller, sensor_gain=sensor_gain
            )
        return self._loops[sensor_gain]

    @property
    def sensitivity(self) -> StateSpace:
        """S at unit sensor gain."""
        return self.at(1.0).output_sensitivity()

    @property
    def parameter(self) -> StateSpace:
        """The Youla parameter: from the noise to the command at unit sensor gain."""
        commanding = self.at(1.0).commanding()
        modes = self.hardware.modes
        return StateSpace(
            A=commanding.A,
            B=commanding.B[:, modes:],
            C=commanding.C,
            D=commanding.D[:, modes:],
            dt_s=commanding.dt_s,
        )

    @property
    def complementary(self) -> StateSpace:
        """``T = 1 - S`` at unit sensor gain."""
        s = self.sensitivity
        return StateSpace(A=s.A, B=s.B, C=-s.C, D=1 - s.D, dt_s=s.dt_s)


def mode_loop(hardware: LoopHardware, parameter: Controller) -> SingleModeLoop:
    """Close the loop of one mode around its Youla parameter."""
    single = mode_hardware(hardware)
    return SingleModeLoop(hardware=single, controller=youla_controller(single, parameter))


def mode_hardware(hardware: LoopHardware) -> LoopHardware:
    """Return the hardware of one mode, with unit sensor and mirror."""
    return LoopHardware(
        frame_rate_hz=hardware.frame_rate_hz,
        delay_frames=hardware.delay_frames,
        modes=1,
        mirror=hardware.mirror,
    )


def append_taps(system: StateSpace, taps: FloatArray) -> StateSpace:
    """Return a system of one output followed by ``taps[0] + taps[1] z^-1 + ...``."""
    n, m = system.B.shape
    late = len(taps) - 1
    A = np.zeros((n + late, n + late))
    B = np.zeros((n + late, m))
    A[:n, :n], B[:n] = system.A, system.B
    if late:
        A[n, :n], B[n] = system.C[0], system.D[0]
        A[n + 1 :, n:-1] = np.eye(late - 1)
    C = np.hstack([taps[0] * system.C, taps[None, 1:]])
    return StateSpace(A=A, B=B, C=C, D=taps[0] * system.D, dt_s=system.dt_s)
