"""Build the end-to-end simulation that a configuration describes."""

from __future__ import annotations

from dataclasses import replace

from lbt_synth.config.plant_and_truth import require_atmosphere, require_telescope
from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ConfigError, name_key
from lbt_synth.interop import EndToEndSetup, EndToEndSystem
from lbt_synth.models import LoopHardware, Truth

_HINT = "an end-to-end simulation needs it"
# keys of the section that belong to the system, not to the set-up
_OF_SYSTEM = {"pixels", "actuators_across", "wind_direction_deg", "calibration_nm"}


def build_end_to_end_setup(
    settings: FileSection, hardware: LoopHardware, truth: Truth
) -> EndToEndSetup:
    """Build the simulation that a configuration describes."""
    pyramid, section = settings.sensor.pyramid, settings.end_to_end
    telescope = require_telescope(settings, _HINT)
    air = require_atmosphere(settings, _HINT)
    if pyramid is None:
        raise ConfigError(f"the key sensor.pyramid is missing; {_HINT}.", path="sensor.pyramid")
    if air.outer_scale_m is None:
        raise ConfigError(
            "atmosphere.outer_scale_m must be a length: phase screens have an end. Try 25.",
            path="atmosphere.outer_scale_m",
        )
    if settings.true_turbulence != "frozen_flow":
        raise ConfigError(
            "truth.turbulence must be frozen_flow for an end-to-end simulation; got "
            f"{settings.true_turbulence}.",
            path="truth.turbulence",
        )
    if hardware.modes != 2:
        raise ConfigError(
            "an end-to-end simulation needs tip and tilt: loop.axes must be 2; got "
            f"{hardware.modes}.",
            path="loop.axes",
        )
    if settings.mirror.modes is None:
        raise ConfigError(f"the key mirror.modes is missing; {_HINT}.", path="mirror.modes")
    for key in ("sensor.matrix", "mirror.influence_matrix"):
        part, name = key.split(".")
        if getattr(getattr(settings, part), name) is not None:
            raise ConfigError(
                f"{key} must be left out for an end-to-end simulation: its sensor and mirror are "
                "calibrated in nanometres of each mode.",
                path=key,
            )
    # the optics do not depend on the sensor gain that the design assumes
    modal = replace(hardware, sensor_matrix=None, influence_matrix=None, modes=2)
    with name_key("end_to_end"):
        system = EndToEndSystem(
            hardware=modal,
            sensing_wavelength_um=pyramid.wavelength_um,
            imaging_wavelength_um=settings.imaging.wavelength_um,
            modes=settings.mirror.modes,
            **telescope.model_dump(),
            **air.model_dump(),
            **pyramid.model_dump(exclude={"wavelength_um"}),
            **section.model_dump(include=_OF_SYSTEM),
        )
        return EndToEndSetup(
            system=system,
            vibrations=truth.vibrations,
            seed=settings.simulation.seed,
            **section.model_dump(exclude=_OF_SYSTEM),
        )
