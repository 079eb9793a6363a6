"""The fields of telemetry: how each is checked, and how it is named and described in files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from lbt_synth.errors import NonFiniteError, ProblemError
from lbt_synth.validation import integer, number

Scalar: TypeAlias = str | float | int | bool

_LENGTHS = ("pm", "um", "mm", "m")
_LONGEST_UNIT = 24


class Layer(NamedTuple):
    """One array: its field, its axes in numpy's order, its unit and its meaning.

    A unit that begins with an underscore is read from the field of that name.
    """

    field: str
    axes: str
    unit: str
    meaning: str

    @property
    def is_series(self) -> bool:
        """Whether it has one row per frame."""
        return self.axes.startswith("frame")

    def unit_in(self, telemetry: Any) -> str:
        """Return the unit that it has in a telemetry."""
        return str(getattr(telemetry, self.unit[1:])) if self.unit[:1] == "_" else self.unit


_TAPS = "c: phi_cor(k) = N (c0 u(k) + c1 u(k-1) + ...)"
_MEASURED = "y(k), of the exposure of frame k-1"
LAYERS = {  # by their names in files
    "COMMANDS": Layer("commands", "frame, command", "_command_unit", "u(k)"),
    "MEASURE": Layer("measurements", "frame, measurement", "_measurement_unit", _MEASURED),
    "RESIDUAL": Layer("residual_nm", "frame, mode", "nm", "phi_res(k), corrected phase"),
    "TOTAL": Layer("total_nm", "frame, mode", "nm", "phi_tot(k), before correction"),
    "SLOPES": Layer("slopes", "frame, slope", "_slope_unit", "what the sensor gave"),
    "TIMES": Layer("times_s", "frame", "s", "time of each frame"),
    "INTERACT": Layer("interaction_matrix", "sensed, mode", "", "S"),
    "RECONST": Layer("reconstructor", "mode, slope", "", "slopes to modes"),
    "INFLUENC": Layer("influence_matrix", "mode, command", "", "N"),
    "MODES": Layer("mode_maps", "mode, row, column", "", "modes, of rms 1"),
    "PSF": Layer("psf", "row, column", "", "image of the camera"),
    "INTGAINS": Layer("integrator_gains", "command", "", "integrator gains"),
    "MIRROR_TAPS": Layer("mirror_taps", "age", "", _TAPS),  # follows from other fields
}
REQUIRED = ("commands", "measurements")
ARRAYS = tuple(layer for layer in LAYERS.values() if layer.field != "mirror_taps")


def _check_text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise ProblemError(f"{name} must be a text; got {value!r}.")
    return value


def _check_unit(value: Any, name: str) -> str:
    fits = isinstance(value, str) and len(value) <= _LONGEST_UNIT and value.strip() == value
    # a FITS card does not keep a quote in every place
    if not fits or not (value.isascii() and value.isprintable()) or "'" in value:
        raise ProblemError(
            f"{name} must be a word of at most {_LONGEST_UNIT} ASCII signs without a quote; got "
            f"{value!r}."
        )
    if name != "slope_unit" and value in _LENGTHS:
        raise ProblemError(f"{name} must be nm for lengths; got {value!r}. Convert them.")
    if name == "command_unit" and not value:
        raise ProblemError("command_unit must not be empty; write 1 for pure numbers.")
    return str(value)


class Fact(NamedTuple):
    """One number or text: how it is checked, and its card in a FITS header, if it has one."""

    check: Callable[[Any, str], Any]
    card: str = ""
    comment: str = ""


_POSITIVE = partial(number, above=0)
_DELAY = partial(number, at_least=0, at_most=1000)
FACTS = {
    "frame_rate_hz": Fact(_POSITIVE, "RATE_HZ", "[Hz] frame rate"),
    "delay_frames": Fact(_DELAY, "DELAY", "[frames] total delay"),
    "sensor_gain": Fact(_POSITIVE, "SENSGAIN", "sensor gain over the interaction matrix"),
    "strehl": Fact(partial(number, at_least=0, at_most=1), "STREHL", "Strehl ratio"),
    "imaging_wavelength_um": Fact(_POSITIVE, "WAVELEN", "[um] of the image and the Strehl ratio"),
    "psf_pixel_mas": Fact(_POSITIVE, "PSFPIX", "[mas] pixel of the image"),
    "diameter_m": Fact(_POSITIVE, "DIAMETER", "[m] telescope"),
    "obstruction": Fact(
        partial(number, at_least=0, below=1), "OBSTRUCT", "central obstruction over the diameter"
    ),
    "seed": Fact(partial(integer, at_least=0), "SEED", "of the simulation"),
    "subaperture_axes": Fact(partial(integer, at_least=1)),
    "name": Fact(_check_text),
    "command_unit": Fact(_check_unit),
    "measurement_unit": Fact(_check_unit),
    "slope_unit": Fact(_check_unit),
    "controller_name": Fact(_check_text),
    "controller_digest": Fact(_check_text),
}


def check_metadata(metadata: Any) -> Mapping[str, Scalar]:
    """Return metadata of words and scalars that nobody can change."""
    if not isinstance(metadata, Mapping):
        raise ProblemError(f"metadata must be a mapping; got {type(metadata).__name__}.")
    out: dict[str, Scalar] = {}
    for key, value in metadata.items():
        if not isinstance(key, str) or not key:
            raise ProblemError(f"the keys of metadata must be words; got {key!r}.")
        out[key] = value.item() if isinstance(value, np.generic) else value
        if not isinstance(out[key], str | float | int | bool):
            raise ProblemError(
                "metadata must hold texts, numbers and truth values; got "
                f"{type(value).__name__} for {key!r}."
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise NonFiniteError(f"metadata must be finite; got {value} for {key!r}.")
    return MappingProxyType(out)


_CONVENTION = (
    "Row k of every series is frame k of 1/frame_rate_hz. "
    "y(k) = sensor_gain S phi_res(k-1) + noise(k): the measurement of frame k is of the exposure "
    "of frame k-1. u(k) is the command computed from y up to y(k). "
    "phi_res(k) = phi_tot(k) - phi_cor(k), {correction}. S is the interaction matrix, N the "
    "influence matrix, each the identity where it is not given. Where slopes are recorded, "
    "slopes(k) = sensor_gain S phi_res(k-1) + noise(k), y(k) = reconstructor slopes(k). "
    "Units: nm rms of wavefront, unless a unit is given."
)
CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N u(k-d+1), d = delay_frames from the "
    "middle of an exposure to the middle of the command computed from it; for d = j+1+f, "
    "phi_cor(k) = N ((1-f) u(k-j) + f u(k-j-1))"
)
MOVING_CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N (c0 u(k) + c1 u(k-1) + c2 u(k-2) + ...) with the mirror taps c "
    "recorded here: the weights of the commands in the position of a mirror that does not settle "
    "at once, averaged over exposure k. They hold the whole delay: d = delay_frames as it would be "
    "with a mirror that settles at once, and the mirror's lag after it"
)
