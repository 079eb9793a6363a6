"""Build the end-to-end simulation that a configuration describes."""

from __future__ import annotations

from dataclasses import replace

from lbt_synth.config.plant_and_truth import require_atmosphere, require_telescope
from lbt_synth.config.schema import FileSection
from lbt_synth.errors import ConfigError, name_key
from lbt_synth.interop import EndToEndSetup, EndToEndSystem
from lbt_synth.models import LoopHardware, Truth

_HINT = "an end-to-end simulation needs it"
_SCREENS = "must be a length: phase screens have an end. Try 25"
_FLOW = "must be frozen_flow for an end-to-end simulation"
_TIP_AND_TILT = "must be 2, as an end-to-end simulation needs tip and tilt"
_CALIBRATED = (
    "must be left out for an end-to-end simulation: its sensor and mirror are calibrated in "
    "nanometres of each mode"
)
# keys of the section that belong to the system, not to the set-up
_OF_SYSTEM = {"pixels", "actuators_across", "wind_direction_deg", "calibration_nm"}


def build_end_to_end_setup(
    settings: FileSection, hardware: LoopHardware, truth: Truth
) -> EndToEndSetup:
    """Build the simulation that a configuration describes."""
    pyramid, section = settings.sensor.pyramid, settings.end_to_end
    telescope = require_telescope(settings, _HINT)
    air = require_atmosphere(settings, _HINT)
    turbulence, modes = settings.true_turbulence, settings.mirror.modes
    influence = settings.mirror.influence_matrix
    for key, wrong, why in (
        ("sensor.pyramid", pyramid is None, f"is missing; {_HINT}"),
        ("atmosphere.outer_scale_m", air.outer_scale_m is None, _SCREENS),
        ("truth.turbulence", turbulence != "frozen_flow", f"{_FLOW}; got {turbulence}"),
        ("loop.axes", hardware.modes != 2, f"{_TIP_AND_TILT}; got {hardware.modes}"),
        ("mirror.modes", modes is None, f"is missing; {_HINT}"),
        ("sensor.matrix", settings.sensor.matrix is not None, _CALIBRATED),
        ("mirror.influence_matrix", influence is not None, _CALIBRATED),
    ):
        if wrong:
            raise ConfigError(f"{key} {why}.", path=key)
    assert pyramid is not None  # refused above
    assert modes is not None  # refused above
    # the optics do not depend on the sensor gain that the design assumes
    modal = replace(hardware, sensor_matrix=None, influence_matrix=None, modes=2)
    with name_key("end_to_end"):
        system = EndToEndSystem(
            hardware=modal,
            sensing_wavelength_um=pyramid.wavelength_um,
            imaging_wavelength_um=settings.imaging.wavelength_um,
            modes=modes,
            **telescope.model_dump(),
            **air.model_dump(),
            **pyramid.model_dump(exclude={"wavelength_um"}),
            **section.model_dump(include=_OF_SYSTEM),
        )
        return EndToEndSetup(
            system=system,
            vibrations=truth.vibrations,
            motions=truth.motions,
            seed=settings.simulation.seed,
            **section.model_dump(exclude=_OF_SYSTEM),
        )
