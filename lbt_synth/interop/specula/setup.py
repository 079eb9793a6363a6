"""Set-up of an end-to-end simulation: system, vibrations, frames, integrators of the modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from lbt_synth.design.modal import MixedController
from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.calibration import Calibration
from lbt_synth.interop.specula.end_to_end_run import EndToEndRun
from lbt_synth.interop.specula.simulation import LARGEST_SEED, RAMP_FRAMES, run_end_to_end
from lbt_synth.interop.specula.system import EndToEndSystem
from lbt_synth.models.vibration.in_a_loop import TrueVibration
from lbt_synth.validation import (
    FloatArray,
    NotNegative,
    check_fields,
    number,
    require_instance,
    set_fields,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EndToEndSetup:
    """An end-to-end simulation as a configuration describes it.

    Parameters
    ----------
    system : EndToEndSystem
        Telescope, air, pyramid, mirror and camera.
    vibrations : tuple of Vibration, SinusoidalVibration or DriftingVibration
        Vibrations of tip and tilt.
    frames, settle_frames, seed : int
        Length of a run, and its seed.
    gain : float
        Integrator gain of every mode that no filter controls.
    leak : float
        Leak of the integrators from mode ``leak_from_mode`` on; those before have none.
        A pyramid can trap a corner of the mirror at whole turns of the phase; a leak
        frees it.
    leak_from_mode : int
        First mode with a leak, counted from 0.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> setup = lbt.load_config("examples/lbt.yaml").end_to_end
    >>> setup.controller(None).n_modes
    672
    """

    system: EndToEndSystem
    vibrations: tuple[TrueVibration, ...] = ()
    frames: Annotated[int, ("at_least", 2)] = 1600
    settle_frames: Annotated[int, ("at_least", RAMP_FRAMES)] = 400
    seed: Annotated[int, ("at_least", 0), ("at_most", LARGEST_SEED)] = 0
    gain: NotNegative = 0.5
    leak: Annotated[float, ("at_least", 0), ("at_most", 1)] = 0.97
    leak_from_mode: Annotated[int, ("at_least", 2)] = 50

    def __post_init__(self) -> None:
        require_instance(self.system, EndToEndSystem)
        check_fields(self)
        set_fields(self, vibrations=tuple(self.vibrations))

    @property
    def leaks(self) -> FloatArray:
        """Leak of each mode's integrator, (modes,)."""
        leaks = np.ones(self.system.modes)
        leaks[self.leak_from_mode :] = self.leak
        return leaks

    def controller(self, filter: Any, *, tip_tilt_gain: float | None = None) -> MixedController:  # noqa: A002
        """Return the mixed controller with a filter for tip and tilt.

        Parameters
        ----------
        filter : Design, Controller, object with ``step(y)`` and ``reset()``, or None
            Controller of tip and tilt, two measurements and two commands; None for
            integrators, as classical control has them.
        tip_tilt_gain : float, optional
            Integrator gain of tip and tilt where there is no filter.

        Returns
        -------
        MixedController
            For the modal measurements of :func:`run_end_to_end`.

        Raises
        ------
        ProblemError
            If the filter is of another loop.
        """
        hardware = getattr(filter, "hardware", None)
        mine = self.system.hardware
        if hardware is not None and (hardware.frame_rate_hz, hardware.delay_frames) != (
            mine.frame_rate_hz,
            mine.delay_frames,
        ):
            raise ProblemError(
                f"the filter must be for the loop of the configuration, {mine.frame_rate_hz:g} Hz "
                f"and {mine.delay_frames:g} frames; got one for {hardware.frame_rate_hz:g} Hz and "
                f"{hardware.delay_frames:g} frames. Design it from this configuration."
            )
        if hardware is not None and hardware.mirror != mine.mirror:
            raise ProblemError(
                "the filter was designed for another mirror than that of the configuration. Design "
                "for its mirror.local_loop, best with --method lqg."
            )
        gains = np.full(self.system.modes, self.gain)
        if tip_tilt_gain is not None:
            gains[:2] = number(tip_tilt_gain, "tip_tilt_gain", at_least=0)
        return MixedController(filter=filter, gains=gains, leak=self.leaks)

    def run(
        self,
        filter: Any,  # noqa: A002
        *,
        tip_tilt_gain: float | None = None,
        calibration: Calibration | None = None,
        cache: Any = None,
        progress: Callable[[int], None] | None = None,
    ) -> EndToEndRun:
        """Close the loop with :meth:`controller`; the other arguments as `run_end_to_end`."""
        return run_end_to_end(
            self.system,
            self.controller(filter, tip_tilt_gain=tip_tilt_gain),
            vibrations=self.vibrations,
            frames=self.frames,
            settle_frames=self.settle_frames,
            seed=self.seed,
            calibration=calibration,
            cache=cache,
            progress=progress,
        )
