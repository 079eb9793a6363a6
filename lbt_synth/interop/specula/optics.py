"""A system, its optics and calibration, by SPECULA (MIT licence), which no other module imports."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import FileError, MissingExtraError, OutputError, ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.storage.array_file import digest, npz_bytes, open_fits, read_npz
from lbt_synth.storage.atomic_files import make_directory, write_atomically
from lbt_synth.storage.input_files import read_bytes
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
_UNCALIBRATED = {  # fields on which the modes and the interaction matrix do not depend
    "hardware",
    "seeing_arcsec",
    "seeing_wavelength_um",
    "wind_speed_m_s",
    "wind_direction_deg",
    "photons",
    "read_noise_electrons",
    "imaging_wavelength_um",
}


_LAYOUT = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EndToEndSystem:
    """A telescope with a pyramid sensor and a mirror of many modes.

    Parameters
    ----------
    hardware : LoopHardware
        Frame rate and delay, or the response of a slow mirror; its sensor and influence
        matrices are the identity, because the optics replace them.
    diameter_m, obstruction, seeing_arcsec : float
        Telescope diameter [m]; diameter of the central obstruction as a fraction of the
        telescope's; seeing at ``seeing_wavelength_um`` [arcsec].
    outer_scale_m, wind_speed_m_s, sensing_wavelength_um : float
        Outer scale [m]; speed of the one layer [m/s]; wavelength of the pyramid [um].
    modulation_lambda_over_d : float
        Radius of its modulation [lambda/D].
    subapertures_across : int
        Subapertures across the pupil.
    photons, read_noise_electrons : float
        Photons per subaperture and frame; read noise per pixel [electrons].
    modes, actuators_across : int, optional
        Controlled modes of the mirror, tip and tilt first; actuators across the mirror, in
        concentric rings.
    seeing_wavelength_um, imaging_wavelength_um : float, optional
        Wavelength of the seeing [um]; wavelength of the camera [um].
    wind_direction_deg : float, optional
        Direction in which the layer moves [degrees]; 0 is along tip.
    pixels : int, optional
        Pixels across the pupil, even.
    calibration_nm : float, optional
        Amplitude of each mode when the interaction matrix is measured [nm rms].

    Raises
    ------
    ProblemError
        If a value is not finite, out of its range, or values clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> config.end_to_end.system.modes, config.end_to_end.system.pixels
    (672, 60)
    """

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
    calibration_nm: Positive = 20.0

    def __post_init__(self) -> None:
        check_fields(self)
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
    def frame_rate_hz(self) -> float:
        """Frame rate [Hz]."""
        return self.hardware.frame_rate_hz

    @property
    def pixel_m(self) -> float:
        """Pixel in the pupil [m]."""
        return self.diameter_m / self.pixels

    @property
    def reference_seeing_arcsec(self) -> float:
        """Seeing at 0.5 um [arcsec]; seeing varies as the wavelength to the power of -1/5."""
        return float(self.seeing_arcsec * (self.seeing_wavelength_um / _REFERENCE_UM) ** 0.2)

    def screen_pixels(self, frames: int) -> int:
        """Return the side of a periodic screen, a power of two, that does not repeat."""
        travelled = frames / self.frame_rate_hz * self.wind_speed_m_s
        length = max(travelled + 2 * self.diameter_m, 6 * self.outer_scale_m)
        return int(2 ** math.ceil(math.log2(length / self.pixel_m)))

    def calibration_facts(self) -> dict[str, Any]:
        """Return what the modes and the interaction matrix depend on."""
        names = [field.name for field in fields(self) if field.name not in _UNCALIBRATED]
        return {name: getattr(self, name) for name in names}


def specula_version() -> str:
    """Return the version of the installed SPECULA, which must be a supported one."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("specula")
    except PackageNotFoundError as error:
        raise MissingExtraError(
            'end-to-end simulation needs SPECULA: pip install "lbt-synth[e2e]".', extra="e2e"
        ) from error
    if not found.startswith(f"{_SUPPORTED}."):
        raise MissingExtraError(
            f"end-to-end simulation needs SPECULA {_SUPPORTED}; got {found}. "
            'Try pip install "lbt-synth[e2e]".',
            extra="e2e",
        )
    return found


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


def make_modes(system: EndToEndSystem) -> Modes:
    """Compute Karhunen-Loeve modes of the influence functions, after tip and tilt."""
    mask = _make_pupil(system, _make_parameters(system)).A
    functions, _, _, _ = _make(
        "lib.compute_zonal_ifunc:compute_zonal_ifunc",
        system.pixels,
        system.actuators_across,
        geom="circular",
        mask=mask.astype(np.float64),
        do_slaving=True,
        dtype=np.float64,
    )
    most = min(functions.shape) - 3
    if system.modes > most:
        raise ProblemError(
            f"{system.modes} modes need a mirror with more actuators: {system.actuators_across} "
            f"across a pupil of {system.pixels} pixels carry at most {most}. Try "
            f"actuators_across={system.actuators_across + 2}, more pixels, or fewer modes."
        )
    base = _specula("lib.modal_base_generator:make_modal_base_from_ifs_fft")
    size, outer = system.diameter_m, system.outer_scale_m
    shapes, _, _ = base(mask, size, functions, 1.0, outer, zern_modes=2, dtype=np.float64)
    return Modes(mask=mask > 0, shapes=np.ascontiguousarray(shapes[: system.modes], np.float32))


def _make_parameters(system: EndToEndSystem) -> Any:
    name = "data_objects.simul_params:SimulParams"
    return _make(name, system.pixels, system.pixel_m, time_step=1 / system.frame_rate_hz)


def _make_pupil(system: EndToEndSystem, parameters: Any) -> Any:
    name = "data_objects.pupilstop:Pupilstop"
    return _make(name, parameters, mask_diam=1.0, obs_diam=system.obstruction)


def _discard_damaged(files: Iterable[Path]) -> None:
    """Delete truncated phase screens, so that they are computed again."""
    for file in files:
        try:
            with open_fits(read_bytes(file, FileError)) as units:
                _ = units[0].data.shape
        except Exception:  # astropy has no common class for what damage makes it raise
            file.unlink()


class Optics:
    """One optical train, exposed frame after frame.

    Without ``screens``, a directory, there is no turbulence, and without a seed no noise.
    """

    def __init__(
        self,
        system: EndToEndSystem,
        modes: Modes,
        *,
        screens: Path | None = None,
        frames: int = 1,
        seed: int | None = None,
    ) -> None:
        self.system, self.modes = system, modes
        self._step_ns = round(1e9 / system.frame_rate_hz)
        self._time_ns = 0
        self._weather: list[Any] = []  # seeing, speed and direction of the wind
        self._where = np.nonzero(modes.mask)
        self._parameters = _make_parameters(system)
        self._pupil = _make_pupil(system, self._parameters)
        self._commands = self._make_input(np.zeros(len(modes.shapes)))
        mirror = self._make_mirror()
        inputs = {"common_layer_list": [self._pupil, mirror.outputs["out_layer"]]}
        air = [] if screens is None else [self._make_air(screens, frames, seed)]
        if air:
            inputs["atmo_layer_list"] = air[0].outputs["layer_list"]
        source = _make("data_objects.source:Source", [0, 0], 0, 1e3 * system.sensing_wavelength_um)
        beam = _make(
            "processing_objects.atmo_propagation:AtmoPropagation",
            self._parameters,
            {"star": source},
            inputs=inputs,
        )
        self._field = beam.outputs["out_star_ef"]
        pyramid, indices = self._make_pyramid()
        detector = self._make_detector(pyramid, seed)
        self._slopes = _make(
            "processing_objects.pyr_slopec:PyrSlopec",
            indices,
            norm_factor=system.photons,
            thr_value=NO_CLAMP,
            inputs={"in_pixels": detector.outputs["out_pixels"]},
        )
        self._camera = _make(
            "processing_objects.psf:PSF",
            self._parameters,
            1e3 * system.imaging_wavelength_um,
            nd=_PSF_SAMPLING,
            inputs={"in_ef": self._field},
        )
        self._train = [*air, mirror, beam, pyramid, detector, self._slopes]
        for part in (*self._train, self._camera):
            part.setup()
        # photons per subaperture, over the whole detector
        flux = system.photons * len(indices.ind_pup) * system.frame_rate_hz
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
            self._weather[0].value[:] = seeing * self.system.reference_seeing_arcsec
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

    def _make_air(self, screens: Path, frames: int, seed: int | None) -> Any:
        system = self.system
        side = system.screen_pixels(frames)
        if side > _LARGEST_SCREEN:
            raise ProblemError(
                f"a run must fit into a phase screen of {_LARGEST_SCREEN} pixels; {frames} frames "
                f"at {system.wind_speed_m_s:g} m/s need {side}. Run fewer frames, with several "
                "seeds."
            )
        weather = {
            "seeing": system.reference_seeing_arcsec,
            "wind_speed": system.wind_speed_m_s,
            "wind_direction": system.wind_direction_deg,
        }
        inputs = {name: self._make_input(np.array([value])) for name, value in weather.items()}
        self._weather = list(inputs.values())
        # SPECULA's file name rounds the pixel, so each kind of screen has its own directory
        facts = [system.pixel_m, system.outer_scale_m, side, specula_version()]
        folder = screens / hashlib.sha256(repr(facts).encode()).hexdigest()[:16]
        seed = (seed or 0) + 1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _discard_damaged(folder.glob(f"ps_seed{seed}_*.fits"))
            return _make(
                "processing_objects.atmo_evolution:AtmoEvolution",
                self._parameters,
                system.outer_scale_m,
                [0.0],
                [1.0],
                data_dir=str(folder),
                pixel_phasescreens=side,
                seed=seed,
                inputs=inputs,
            )
        except OSError as error:
            raise OutputError(
                f"cannot make or read a phase screen in {folder}: {error}. Name another "
                "directory with --cache.",
                path=folder,
            ) from error

    def _make_pyramid(self) -> tuple[Any, Any]:
        system = self.system
        across = system.subapertures_across
        side = 2 * across + 3 * _PUPIL_GAP
        natural = system.sensing_wavelength_um * 1e-6 / system.pixel_m * 180 * 3600 / np.pi
        steps = 4 * int(np.ceil(2 * np.pi * system.modulation_lambda_over_d / 4))
        pyramid = _make(
            "processing_objects.modulated_pyramid:ModulatedPyramid",
            self._parameters,
            1e3 * system.sensing_wavelength_um,
            min(natural, _FIELD_ARCSEC),
            across,
            output_resolution=side,
            mod_amp=system.modulation_lambda_over_d,
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
        lit = (radius <= across / 2) & (radius >= system.obstruction * across / 2)
        indices = np.stack([np.flatnonzero(one) for one in lit], axis=1)
        return pyramid, _make(
            "data_objects.pupdata:PupData",
            ind_pup=indices,
            radius=np.full(4, across / 2),
            cx=x,
            cy=y,
            framesize=[side, side],
        )

    def _make_detector(self, pyramid: Any, seed: int | None) -> Any:
        noisy = seed is not None
        return _make(
            "processing_objects.ccd:CCD",
            self._parameters,
            [pyramid.final_ccd_side] * 2,
            1 / self.system.frame_rate_hz,
            1.0,
            photon_noise=noisy,
            readout_noise=noisy,
            readout_level=self.system.read_noise_electrons,
            photon_seed=2 * (seed or 0),
            readout_seed=2 * (seed or 0) + 1,
            inputs={"in_i": pyramid.outputs["out_i"]},
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What is measured once, before a loop is closed."""

    modes: Modes  # shapes of the mirror
    reference: FloatArray  # (q,): slopes of a flat wavefront
    # (n, q): inverse of the interaction matrix (slopes per nanometre of each mode)
    reconstructor: FloatArray
    key: str  # digest of everything that it depends on
    cached: bool  # whether it came from the cache


def cache_directory(path: str | os.PathLike[str] | None = None) -> Path:
    """Return the directory for calibrations and phase screens; create it if it is missing."""
    if path is None:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        path = Path(base) / "lbt_synth"
    return make_directory(path)


def calibrate(
    system: EndToEndSystem,
    *,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Calibration:
    """Compute the modes, measure the interaction matrix without noise, and invert it.

    Each mode is pushed and pulled by ``system.calibration_nm`` on a flat wavefront. The
    result is cached under a digest of everything that it depends on, including SPECULA's
    version; what a damaged file held is measured again.

    Parameters
    ----------
    system : EndToEndSystem
        The system.
    cache : path-like, optional
        Directory of the cache; see :func:`cache_directory`.
    progress : callable, optional
        Called with the number of modes measured since its last call.

    Returns
    -------
    Calibration
        The calibration.

    Raises
    ------
    MissingExtraError
        If SPECULA is missing.
    ProblemError
        If the mirror cannot carry the modes, or the sensor cannot tell them apart.
    OutputError
        If the cache cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> system = lbt.load_config("examples/lbt.yaml").end_to_end.system
    >>> found = lbt.interop.calibrate(system)  # doctest: +SKIP
    >>> len(found.reconstructor) == system.modes  # doctest: +SKIP
    True
    >>> lbt.interop.calibrate("examples/lbt.yaml")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: expected an EndToEndSystem; got str.
    """
    require_instance(system, EndToEndSystem)
    facts = {"layout": _LAYOUT, "specula": specula_version(), **system.calibration_facts()}
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    path = cache_directory(cache) / f"calibration-{key[:16]}.npz"
    arrays = _read_cached(path, key)
    cached = arrays is not None
    if arrays is None:
        arrays = _measure(system, progress)
        meta = {"key": key, "facts": facts}
        meta["digest"] = digest(arrays, meta)
        write_atomically(path, npz_bytes(arrays, json.dumps(meta)))
    elif progress is not None:
        progress(system.modes)
    rank = np.linalg.matrix_rank(arrays["INTERACTION"])
    if rank < system.modes:
        raise ProblemError(
            f"the sensor must tell {system.modes} modes apart; got an interaction matrix of rank "
            f"{rank}. Control fewer modes."
        )
    return Calibration(
        modes=Modes(mask=arrays["MASK"] > 0, shapes=arrays["SHAPES"].astype(np.float32)),
        reference=frozen_copy(arrays["REFERENCE"]),
        reconstructor=frozen_copy(np.linalg.pinv(arrays["INTERACTION"])),
        key=key,
        cached=cached,
    )


def _measure(
    system: EndToEndSystem, progress: Callable[[int], None] | None
) -> dict[str, npt.NDArray[Any]]:
    """Compute the modes; measure the slopes of a flat wavefront and of each mode."""
    modes = make_modes(system)
    optics = Optics(system, modes)
    still, n = np.zeros(2), len(modes.shapes)
    reference = optics.expose(np.zeros(n), still)
    matrix = np.empty((reference.size, n))
    for mode in range(n):
        push = np.zeros(n)
        push[mode] = -system.calibration_nm  # a correction is subtracted from the phase
        pair = optics.expose(push, still) - optics.expose(-push, still)
        matrix[:, mode] = pair / (2 * system.calibration_nm)
        if progress is not None:
            progress(1)
    return {
        "MASK": modes.mask.astype(np.uint8),
        "SHAPES": modes.shapes,
        "REFERENCE": reference,
        "INTERACTION": matrix,
    }


def _read_cached(path: Path, key: str) -> dict[str, npt.NDArray[Any]] | None:
    """Return the arrays of a file, None if it is missing, damaged or another one."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        arrays, text = read_npz(path.read_bytes())
        meta = json.loads(text)
        if meta["key"] == key and meta["digest"] == digest(arrays, meta):
            return dict(arrays)
    return None
