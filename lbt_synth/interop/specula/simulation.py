"""The end-to-end simulation: a controller in closed loop with SPECULA's optics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.design.modal import MixedController
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.interop.specula.optics import (
    RAMP_FRAMES,
    Calibration,
    EndToEndSetup,
    Optics,
    calibrate,
)
from lbt_synth.linear import Controller
from lbt_synth.loop.disturbances import draw_others, draw_phase
from lbt_synth.loop.simulation import SteppedController, run_frames
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, require_instance

_BATCHES = 8
_TIP_TILT = slice(2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EndToEndRun:
    """Series and images of a closed loop, after it has settled; row k of a series is frame k."""

    setup: EndToEndSetup
    strehl_series: FloatArray  # intensity in the image's centre over that of a perfect image
    other_modes_series: FloatArray  # the same without tip and tilt
    measurements: FloatArray  # (frames, modes): y(k) [nm rms], from the exposure of frame k-1
    commands: FloatArray  # (frames, modes): u(k) [nm rms], from y(k)
    residual_nm: FloatArray  # (frames, modes): phase of exposure k [nm rms]
    psf: FloatArray  # (h, h): mean image, of sum 1
    psf_pixel_mas: float

    @property
    def frames(self) -> int:
        """Frames of the exposure."""
        return len(self.strehl_series)

    @property
    def strehl(self) -> float:
        """Strehl ratio of the long exposure."""
        return float(np.mean(self.strehl_series))

    @property
    def strehl_error(self) -> float:
        """Standard error of the Strehl ratio in this air, of eight batches; nan for short runs."""
        batches = np.array_split(self.strehl_series, _BATCHES)
        if len(self.strehl_series) < 2 * _BATCHES:
            return float("nan")
        means = [float(np.mean(batch)) for batch in batches]
        return float(np.std(means, ddof=1) / np.sqrt(_BATCHES))

    @property
    def other_modes_strehl(self) -> float:
        """Strehl ratio of the long exposure if tip and tilt were perfect."""
        return float(np.mean(self.other_modes_series))

    @property
    def rms_nm(self) -> FloatArray:
        """Residual of each mode [nm rms], (modes,)."""
        return np.asarray(np.sqrt(np.mean(self.residual_nm**2, axis=0)))

    def optical_gain(
        self, modes: slice = slice(None), *, together: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the gain of the sensor in the loop, of each mode or of some together.

        Beside it are its standard error for white noise, and what is left of measurements [nm rms].
        """
        axis = None if together else 0
        y, phase = self.measurements[1:, modes], self.residual_nm[:-1, modes]
        power = np.sum(phase**2, axis=axis)
        gain = np.asarray(np.sum(y * phase, axis=axis) / power)
        rest = np.mean((y - gain * phase) ** 2, axis=axis)
        return gain, np.asarray(np.sqrt(rest / power)), np.asarray(np.sqrt(rest))

    @property
    def tip_tilt_gain(self) -> float:
        """Optical gain of tip and tilt together."""
        return float(self.optical_gain(_TIP_TILT, together=True)[0])

    def summary(self) -> dict[str, Any]:
        """Return the main numbers; None stands for NaN, which JSON does not have."""
        rms, error = self.rms_nm, self.strehl_error
        gain, gain_error, noise_nm = map(float, self.optical_gain(_TIP_TILT, together=True))
        return {
            "strehl": self.strehl,
            "strehl_error": None if math.isnan(error) else error,
            "other_modes_strehl": self.other_modes_strehl,
            "tip_rms_nm": float(rms[0]),
            "tilt_rms_nm": float(rms[1]),
            "other_modes_rms_nm": float((rms[2:] ** 2).sum() ** 0.5),
            "tip_tilt_gain": gain,
            "tip_tilt_gain_error": gain_error,
            "tip_tilt_noise_nm": noise_nm,
        }


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


def accompany_filter(design: Design, setup: EndToEndSetup) -> AccompaniedFilter:
    """Return a filter of tip and tilt with the readings of its accelerometers in a run.

    Readings follow the motions of :func:`run_end_to_end`; the pyramid is the only wavefront sensor.
    """
    shaken = setup.shaken
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
    size, rng = _run_size(setup), np.random.default_rng(setup.seed)
    _, lines = draw_phase(shaken, hardware, rng=rng, oscillators=True, frame_means=True, **size)
    (own_rng,) = rng.spawn(1)
    others = draw_others(shaken, hardware, lines, own_rng, **size)
    return AccompaniedFilter(
        controller=design.controllers[missing], others=others[0], hardware=hardware
    )


def _run_size(setup: EndToEndSetup) -> dict[str, int]:
    settle = setup.settle_frames
    return {"frames": settle + setup.frames, "cases": 1, "zero_frame": settle}


def mix_controller(setup: EndToEndSetup, filter: Any) -> MixedController:  # noqa: A002
    """Return the controller of all modes: a filter of tip and tilt, integrators for the others."""
    if getattr(filter, "other_sensors", ()):
        filter = accompany_filter(filter, setup)  # noqa: A001
    expected = setup.hardware
    hardware = getattr(filter, "hardware", None) or expected
    loops = [(h.frame_rate_hz, h.delay_frames, h.mirror) for h in (expected, hardware)]
    if loops[0] != loops[1]:
        mirror = "" if hardware.mirror == expected.mirror else ", and for another mirror"
        raise ProblemError(
            "the filter must be for the loop of the configuration, "
            f"{expected.frame_rate_hz:g} Hz and {expected.delay_frames:g} frames; got one for "
            f"{hardware.frame_rate_hz:g} Hz and {hardware.delay_frames:g} frames{mirror}. "
            "Design it from this configuration."
        )
    gains = np.full(setup.modes, setup.gain)
    return MixedController(filter=filter, gains=gains, leak=setup.leaks)


def run_end_to_end(
    setup: EndToEndSetup,
    controller: Any,
    *,
    calibration: Calibration | None = None,
    progress: Callable[[int], None] | None = None,
) -> EndToEndRun:
    """Close the loop with a pyramid, a mirror and moving air, all simulated by SPECULA.

    In frame k, as in :class:`LoopHardware`: the controller is given y(k), the modal
    coefficients of the slopes of exposure k-1, and returns u(k); the mirror of exposure k
    has the shape of ``setup.hardware.mirror_taps`` times u(k), u(k-1), ...; a fractional
    delay and a moving mirror enter as their mean over the exposure. The seeing rises
    from zero in the first 200 frames, so that the sensor does not lose the phase by whole
    turns before the loop is closed.

    The random parts depend on the seed, the vibrations and the number of frames only:
    controllers that are given the same ones meet the same air, vibrations and noise.

    Parameters
    ----------
    setup : EndToEndSetup
        Telescope, vibrations, length and seed: ``config.end_to_end``.
    controller : Design, Controller, object with ``step(y)`` and ``reset()``, MixedController, None
        Controller of tip and tilt, two measurements and two commands, beside integrators for the
        other modes; None for integrators alone; or a MixedController of all modes. One of another
        loop is refused. A design of several sensors has accelerometers that follow the vibrations;
        further wavefront sensors are not read.
    calibration : Calibration, optional
        Calibration of another run of this system; by default it is measured.
    progress : callable, optional
        Called with the number of frames run since its last call.

    Returns
    -------
    EndToEndRun
        ``strehl`` and its ``strehl_error``, ``rms_nm`` and ``optical_gain()`` of each mode, the
        series ``measurements``, ``commands`` and ``residual_nm`` (frames, modes) [nm rms], and the
        mean image ``psf``.

    Raises
    ------
    MissingExtraError
        If SPECULA is missing.
    ProblemError
        If the controller is for another loop, or does not return one finite command per mode.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> run = lbt.interop.run_end_to_end(
    ...     config.end_to_end, lbt.kalman(config.plant)
    ... )  # doctest: +SKIP

    It takes two minutes; what cannot run is refused at once:

    >>> other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    >>> lbt.interop.run_end_to_end(config.end_to_end, other)
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: the filter must be for the loop of the configuration, 800 Hz \
and 2 frames; got one for 1000 Hz and 2 frames. Design it from this configuration.
    """
    require_instance(setup, EndToEndSetup)
    if not isinstance(controller, MixedController):
        controller = mix_controller(setup, controller)
    how: dict[str, Any] = {**_run_size(setup), "frame_means": True, "oscillators": True}
    rng = np.random.default_rng(setup.seed)
    phase, _ = draw_phase(setup.shaken, setup.hardware, rng=rng, **how)
    calibration = calibrate(setup) if calibration is None else calibration
    optics = Optics(setup, calibration.modes, air=True)
    fields = _run_frames(optics, calibration, controller, phase[0], progress)
    return EndToEndRun(setup=setup, **fields, psf_pixel_mas=optics.psf_pixel_mas)


def _run_frames(
    optics: Optics,
    calibration: Calibration,
    controller: SteppedController,
    tilts: FloatArray,
    progress: Callable[[int], None] | None,
) -> dict[str, FloatArray]:
    """Run all frames; return the series and the mean image after those that settle."""
    modes, settle, kept = calibration.modes, optics.setup.settle_frames, optics.setup.frames
    inverse, n = calibration.reconstructor, len(calibration.modes.shapes)
    out = {name: np.empty((kept, n)) for name in ("measurements", "commands", "residual_nm")}
    strehl, others = np.empty(kept), np.empty(kept)
    psf, slopes, y = np.zeros(()), calibration.reference, np.zeros(n)

    def measure(k: int) -> FloatArray:
        nonlocal y
        y = inverse @ (slopes - calibration.reference)
        return y

    def expose(k: int, correction: FloatArray, command: FloatArray) -> None:
        nonlocal psf, slopes
        slopes = optics.expose(correction, tilts[k], seeing=min(1.0, (k + 1) / RAMP_FRAMES))
        row = k - settle
        if row >= 0:
            strehl[row], frame = optics.image()
            psf = psf + frame
            phase = optics.phase_nm()
            residual = modes.coefficients(phase)
            rest = phase - residual[:2].astype(np.float32) @ modes.shapes[:2]
            others[row] = np.abs(np.mean(np.exp(1j * turn * rest))) ** 2
            for name, value in zip(out, (y, command, residual), strict=True):
                out[name][row] = value
        if progress is not None:
            progress(1)

    taps = optics.setup.hardware.mirror_taps
    turn = 2 * np.pi / (1e3 * optics.setup.imaging_wavelength_um)
    run_frames(controller, measure, expose, frames=len(tilts), shape=(n,), taps=taps)
    return {**out, "strehl_series": strehl, "other_modes_series": others, "psf": psf / kept}
