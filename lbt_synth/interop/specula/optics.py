"""A telescope, its optics and calibration, by SPECULA (MIT licence), which nothing else imports."""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.models.sensor_suite import Motions
from lbt_synth.models.vibration import TrueVibration
from lbt_synth.validation import (
    Finite,
    FloatArray,
    NotNegative,
    Obstruction,
    Positive,
    check_fields,
    frozen_copy,
    require_instance,
)

_SUPPORTED = "1.1"
NO_CLAMP = -1e4  # if negative pixels were set to zero, a fifth of the gain would be lost
_PUPIL_GAP = 4  # subapertures between the four pupils on the detector, and around them
_FIELD_ARCSEC = 2.0
_LARGEST_SCREEN = 16384
_PSF_SAMPLING = 3
_REFERENCE_UM = 0.5  # wavelength at which SPECULA takes the seeing
_MOST_PIXELS = 1024
RAMP_FRAMES = 200  # over which the seeing rises, so that no turn of the phase is lost
LARGEST_SEED = 2**31 - 2  # the detector doubles it, in 32 bits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EndToEndSetup:
    """A telescope with a pyramid and a mirror of many modes, its vibrations, and a run with it."""

    hardware: LoopHardware
    diameter_m: Positive
    obstruction: Obstruction
    seeing_arcsec: Positive
    outer_scale_m: Positive
    wind_speed_m_s: Positive
    sensing_wavelength_um: Positive
    modulation_lambda_over_d: Positive
    subapertures_across: Annotated[int, ("at_least", 2)]
    photons: Positive
    read_noise_electrons: NotNegative
    modes: Annotated[int, ("at_least", 3)] = 672
    actuators_across: Annotated[int, ("at_least", 3)] = 31
    seeing_wavelength_um: Positive = _REFERENCE_UM
    imaging_wavelength_um: Positive = 2.2
    wind_direction_deg: Finite = 0.0
    pixels: Annotated[int, ("at_least", 8)] = 60
    calibration_nm: Positive = 20.0  # of each mode, when the interaction matrix is measured
    vibrations: tuple[TrueVibration, ...] = ()
    motions: Motions = ()  # of channels of accelerometers with each vibration
    frames: Annotated[int, ("at_least", 2)] = 1600
    settle_frames: Annotated[int, ("at_least", RAMP_FRAMES)] = 400
    seed: Annotated[int, ("at_least", 0), ("at_most", LARGEST_SEED)] = 0
    gain: NotNegative = 0.5  # of the integrator of each mode that no filter controls
    # it frees corners of the mirror that a pyramid traps at whole turns of the phase
    leak: Annotated[float, ("at_least", 0), ("at_most", 1)] = 0.97
    leak_from_mode: Annotated[int, ("at_least", 2)] = 50

    def __post_init__(self) -> None:
        check_fields(self, vibrations=tuple(self.vibrations))
        for name in ("sensor_matrix", "influence_matrix"):
            matrix = getattr(self.hardware, name)
            if not np.array_equal(matrix, np.eye(2)):
                raise ProblemError(
                    f"the hardware of an end-to-end simulation must have two modes and the "
                    f"identity as its {name}, for the optics take its place; got {matrix.shape}."
                )
        if self.pixels % 2 or self.pixels < self.subapertures_across or self.pixels > _MOST_PIXELS:
            raise ProblemError(
                f"pixels must be even, at least subapertures_across ({self.subapertures_across}) "
                f"and at most {_MOST_PIXELS}; got {self.pixels}. Try "
                f"{2 * self.subapertures_across}."
            )

    @property
    def pixel_m(self) -> float:
        """Pixel in the pupil [m]."""
        return self.diameter_m / self.pixels

    @property
    def reference_seeing_arcsec(self) -> float:
        """Seeing at 0.5 um [arcsec]; seeing varies as the wavelength to the power of -1/5."""
        return float(self.seeing_arcsec * (self.seeing_wavelength_um / _REFERENCE_UM) ** 0.2)

    @property
    def screen_pixels(self) -> int:
        """Side of a periodic screen, a power of two, that does not repeat in a run."""
        total = self.settle_frames + self.frames
        travelled = total / self.hardware.frame_rate_hz * self.wind_speed_m_s
        length = max(travelled + 2 * self.diameter_m, 6 * self.outer_scale_m)
        return int(2 ** math.ceil(math.log2(length / self.pixel_m)))

    @property
    def leaks(self) -> FloatArray:
        """Leak of each mode's integrator, (modes,)."""
        leaks = np.ones(self.modes)
        leaks[self.leak_from_mode :] = self.leak
        return leaks

    @property
    def shaken(self) -> Truth:
        """The vibrations, and how channels of accelerometers move with them."""
        return Truth(turbulence=None, vibrations=self.vibrations, motions=self.motions)


def specula_version() -> str:
    """Return the version of the installed SPECULA, which must be a supported one."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        installed = version("specula")
    except PackageNotFoundError:
        installed = "none"
    if not installed.startswith(f"{_SUPPORTED}."):
        raise MissingExtraError(
            f"end-to-end simulation needs SPECULA {_SUPPORTED}; got {installed}. "
            'Try pip install "lbt-synth[e2e]".',
            extra="e2e",
        )
    return installed


def _specula(name: str) -> Any:
    """Return a class or function of SPECULA (``module:name``); initialise the library first."""
    specula_version()
    import specula

    if specula.global_precision is None:  # not initialised yet: CPU, single precision
        specula.init(-1, precision=1, log_level=logging.ERROR)
    module, _, name = name.rpartition(":")
    return getattr(importlib.import_module(f"specula.{module}"), name)


def _make(name: str, *arguments: Any, inputs: Mapping[str, Any] | None = None, **more: Any) -> Any:
    """Make an object of SPECULA, and connect its inputs."""
    made = _specula(name)(*arguments, **more)
    for key, value in (inputs or {}).items():
        made.inputs[key].set(value)
    return made


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Modes:
    """Modes of the mirror over the illuminated pixels of the pupil."""

    mask: npt.NDArray[np.bool_]  # illuminated pixels, (pixels, pixels)
    # (modes, illuminated), of rms 1, orthogonal to each other and to piston, tip and tilt first
    shapes: npt.NDArray[np.float32]

    def coefficients(self, phase_nm: npt.NDArray[np.float32]) -> FloatArray:
        """Return the modal coefficients (modes,) of a phase (illuminated,) [nm]."""
        projected = np.asarray(self.shapes @ phase_nm, dtype=np.float64)
        return np.asarray(projected / self.shapes.shape[1])


def make_modes(setup: EndToEndSetup) -> Modes:
    """Compute Karhunen-Loeve modes of the influence functions, after tip and tilt."""
    mask = _make_pupil(setup)[1].A
    functions, _, _, _ = _make(
        "lib.compute_zonal_ifunc:compute_zonal_ifunc",
        setup.pixels,
        setup.actuators_across,
        geom="circular",
        mask=mask.astype(np.float64),
        do_slaving=True,
        dtype=np.float64,
    )
    most = min(functions.shape) - 3
    if setup.modes > most:
        raise ProblemError(
            f"{setup.modes} modes need a mirror with more actuators: {setup.actuators_across} "
            f"across a pupil of {setup.pixels} pixels carry at most {most}. Try "
            f"actuators_across={setup.actuators_across + 2}, more pixels, or fewer modes."
        )
    base = _specula("lib.modal_base_generator:make_modal_base_from_ifs_fft")
    size, outer = setup.diameter_m, setup.outer_scale_m
    shapes, _, _ = base(mask, size, functions, 1.0, outer, zern_modes=2, dtype=np.float64)
    return Modes(mask=mask > 0, shapes=np.ascontiguousarray(shapes[: setup.modes], np.float32))


def _make_pupil(setup: EndToEndSetup) -> tuple[Any, Any]:
    """Return the parameters of a simulation, and its pupil."""
    name, step_s = "data_objects.simul_params:SimulParams", 1 / setup.hardware.frame_rate_hz
    parameters = _make(name, setup.pixels, setup.pixel_m, time_step=step_s)
    name = "data_objects.pupilstop:Pupilstop"
    return parameters, _make(name, parameters, mask_diam=1.0, obs_diam=setup.obstruction)


class Optics:
    """One optical train, exposed frame after frame; without the air there is no noise either."""

    def __init__(self, setup: EndToEndSetup, modes: Modes, *, air: bool = False) -> None:
        self.setup, self.modes = setup, modes
        self._step_ns = round(1e9 / setup.hardware.frame_rate_hz)
        self._time_ns = 0
        self._weather: list[Any] = []  # seeing, speed and direction of the wind
        self._where = np.nonzero(modes.mask)
        self._parameters, self._pupil = _make_pupil(setup)
        self._commands = self._make_input(np.zeros(len(modes.shapes)))
        mirror = self._make_mirror()
        inputs = {"common_layer_list": [self._pupil, mirror.outputs["out_layer"]]}
        screens = [self._make_air()] if air else []
        for screen in screens:
            inputs["atmo_layer_list"] = screen.outputs["layer_list"]
        source = _make("data_objects.source:Source", [0, 0], 0, 1e3 * setup.sensing_wavelength_um)
        beam = _make(
            "processing_objects.atmo_propagation:AtmoPropagation",
            self._parameters,
            {"star": source},
            inputs=inputs,
        )
        self._field = beam.outputs["out_star_ef"]
        pyramid, indices = self._make_pyramid()
        detector = self._make_detector(pyramid, noisy=air)
        self._slopes = _make(
            "processing_objects.pyr_slopec:PyrSlopec",
            indices,
            norm_factor=setup.photons,
            thr_value=NO_CLAMP,
            inputs={"in_pixels": detector.outputs["out_pixels"]},
        )
        self._camera = _make(
            "processing_objects.psf:PSF",
            self._parameters,
            1e3 * setup.imaging_wavelength_um,
            nd=_PSF_SAMPLING,
            inputs={"in_ef": self._field},
        )
        self._train = [*screens, mirror, beam, pyramid, detector, self._slopes]
        for part in (*self._train, self._camera):
            part.setup()
        # photons per subaperture, over the whole detector
        flux = setup.photons * len(indices.ind_pup) * setup.hardware.frame_rate_hz
        self._field.S0 = flux / float(self._field.masked_area())

    def _make_mirror(self) -> Any:
        """Return the mirror that the commands move, in the modes."""
        return _make(
            "processing_objects.dm:DM",
            self._parameters,
            0,
            ifunc=_make(
                "data_objects.ifunc:IFunc",
                ifunc=self.modes.shapes,
                mask=self.modes.mask.astype(np.float32),
            ),
            sign=1,
            inputs={"in_command": self._commands},
        )

    def expose(
        self, commands_nm: FloatArray, tilts_nm: Sequence[float] | FloatArray, *, seeing: float = 1
    ) -> FloatArray:
        """Expose one frame with commands (modes,) and tilts (2,), and return its slopes (q,)."""
        self._time_ns += self._step_ns
        phase_nm = -np.asarray(commands_nm)  # a correction is subtracted from the phase
        phase_nm[:2] += tilts_nm
        self._commands.value[:] = phase_nm
        if self._weather:
            self._weather[0].value[:] = seeing * self.setup.reference_seeing_arcsec
        for signal in (self._commands, self._pupil, *self._weather):
            signal.generation_time = self._time_ns
        self._trigger(self._train)
        return np.array(self._slopes.outputs["out_slopes"].slopes, dtype=np.float64)

    def image(self) -> tuple[float, FloatArray]:
        """Return the Strehl ratio and the image of the last frame."""
        self._trigger([self._camera])
        return float(self._camera.sr.value), np.array(self._camera.psf.value, dtype=np.float64)

    def phase_nm(self) -> npt.NDArray[np.float32]:
        """Return the residual phase of the last frame over the illuminated pixels [nm]."""
        return np.array(self._field.phaseInNm[self._where])

    @property
    def psf_pixel_mas(self) -> float:
        """Pixel of the image [mas]."""
        return float(self._camera.psf_pixel_size)

    def _make_input(self, value: FloatArray) -> Any:
        value = np.array(value, dtype=np.float32)
        return _make("base_value:BaseValue", value=value, precision=1)

    def _trigger(self, parts: Sequence[Any]) -> None:
        for part in parts:
            if part.check_ready(self._time_ns):
                part.trigger()
                part.post_trigger()

    def _make_air(self) -> Any:
        setup = self.setup
        if setup.screen_pixels > _LARGEST_SCREEN:
            frames = setup.settle_frames + setup.frames
            raise ProblemError(
                f"a run must fit into a phase screen of {_LARGEST_SCREEN} pixels; {frames} frames "
                f"at {setup.wind_speed_m_s:g} m/s need {setup.screen_pixels}. Run fewer frames, "
                "with several seeds."
            )
        weather = {
            "seeing": setup.reference_seeing_arcsec,
            "wind_speed": setup.wind_speed_m_s,
            "wind_direction": setup.wind_direction_deg,
        }
        inputs = {name: self._make_input(np.array([value])) for name, value in weather.items()}
        self._weather = list(inputs.values())
        with TemporaryDirectory() as folder:  # SPECULA writes its screen, and reads it at once
            return _make(
                "processing_objects.atmo_evolution:AtmoEvolution",
                self._parameters,
                setup.outer_scale_m,
                [0.0],
                [1.0],
                data_dir=folder,
                pixel_phasescreens=setup.screen_pixels,
                seed=setup.seed + 1,
                inputs=inputs,
            )

    def _make_pyramid(self) -> tuple[Any, Any]:
        setup = self.setup
        across = setup.subapertures_across
        side = 2 * across + 3 * _PUPIL_GAP
        natural = setup.sensing_wavelength_um * 1e-6 / setup.pixel_m * 180 * 3600 / np.pi
        steps = 4 * int(np.ceil(2 * np.pi * setup.modulation_lambda_over_d / 4))
        pyramid = _make(
            "processing_objects.modulated_pyramid:ModulatedPyramid",
            self._parameters,
            1e3 * setup.sensing_wavelength_um,
            min(natural, _FIELD_ARCSEC),
            across,
            output_resolution=side,
            mod_amp=setup.modulation_lambda_over_d,
            mod_step=steps,
            pup_dist=across + _PUPIL_GAP,
            inputs={"in_ef": self._field},
        )
        # the four pupils lie on whole pixels around the middle of the detector
        middle, apart = (side - 1) / 2, (across + _PUPIL_GAP) / 2
        x = middle + apart * np.array([1, -1, -1, 1])
        y = middle + apart * np.array([-1, -1, 1, 1])
        rows, columns = np.mgrid[:side, :side]
        radius = np.hypot(columns - x[:, None, None], rows - y[:, None, None])
        lit = (radius <= across / 2) & (radius >= setup.obstruction * across / 2)
        indices = np.stack([np.flatnonzero(one) for one in lit], axis=1)
        return pyramid, _make(
            "data_objects.pupdata:PupData",
            ind_pup=indices,
            radius=np.full(4, across / 2),
            cx=x,
            cy=y,
            framesize=[side, side],
        )

    def _make_detector(self, pyramid: Any, *, noisy: bool) -> Any:
        return _make(
            "processing_objects.ccd:CCD",
            self._parameters,
            [pyramid.final_ccd_side] * 2,
            1 / self.setup.hardware.frame_rate_hz,
            1.0,
            photon_noise=noisy,
            readout_noise=noisy,
            readout_level=self.setup.read_noise_electrons,
            photon_seed=2 * self.setup.seed,
            readout_seed=2 * self.setup.seed + 1,
            inputs={"in_i": pyramid.outputs["out_i"]},
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What is measured once, before a loop is closed."""

    modes: Modes  # shapes of the mirror
    reference: FloatArray  # (q,): slopes of a flat wavefront
    # (n, q): inverse of the interaction matrix (slopes per nanometre of each mode)
    reconstructor: FloatArray


def calibrate(
    setup: EndToEndSetup, *, progress: Callable[[int], None] | None = None
) -> Calibration:
    """Compute the modes, push and pull each of them on a flat wavefront, without noise, and invert.

    ``progress`` is called with the number of modes measured since its last call.
    """
    require_instance(setup, EndToEndSetup)
    modes = make_modes(setup)
    optics = Optics(setup, modes)
    still, n = np.zeros(2), len(modes.shapes)
    reference = optics.expose(np.zeros(n), still)
    matrix = np.empty((reference.size, n))
    for mode in range(n):
        push = np.zeros(n)
        push[mode] = -setup.calibration_nm  # a correction is subtracted from the phase
        pair = optics.expose(push, still) - optics.expose(-push, still)
        matrix[:, mode] = pair / (2 * setup.calibration_nm)
        if progress is not None:
            progress(1)
    rank = np.linalg.matrix_rank(matrix)
    if rank < matrix.shape[1]:
        raise ProblemError(
            f"the sensor must tell {matrix.shape[1]} modes apart; got an interaction matrix of "
            f"rank {rank}. Control fewer modes."
        )
    inverse = frozen_copy(np.linalg.pinv(matrix))
    return Calibration(modes=modes, reference=frozen_copy(reference), reconstructor=inverse)
