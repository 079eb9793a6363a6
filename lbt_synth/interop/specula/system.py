"""The system of an end-to-end simulation: telescope, air, pyramid, mirror, camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.validation import Finite, NotNegative, Obstruction, Positive, check_fields

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
        """Return the side of a square phase screen that does not repeat within some frames.

        It is a power of two, and at least six outer scales, because the screen is periodic and
        holds nothing slower.
        """
        travelled = frames / self.frame_rate_hz * self.wind_speed_m_s
        length = max(travelled + 2 * self.diameter_m, 6 * self.outer_scale_m)
        return int(2 ** math.ceil(math.log2(length / self.pixel_m)))

    def calibration_facts(self) -> dict[str, Any]:
        """Return what the modes and the interaction matrix depend on."""
        names = [field.name for field in fields(self) if field.name not in _UNCALIBRATED]
        return {name: getattr(self, name) for name in names}
