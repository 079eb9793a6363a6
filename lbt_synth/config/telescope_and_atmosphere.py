"""The optional sections telescope and atmosphere, and what is built from them."""

from __future__ import annotations

from lbt_synth.config.schema import AtmosphereSection, FileSection, TelescopeSection
from lbt_synth.errors import ConfigError
from lbt_synth.models import Atmosphere, nm_per_mas

WEATHER = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")  # keys of FrozenFlows


def require_telescope(settings: FileSection, reason: str) -> TelescopeSection:
    """Return the section ``telescope``; raise ConfigError with the reason if it is missing."""
    if settings.telescope is None:
        raise ConfigError(f"the key telescope is missing: {reason}.", path="telescope")
    return settings.telescope


def require_atmosphere(settings: FileSection, reason: str) -> AtmosphereSection:
    """Return the section ``atmosphere``; raise ConfigError with the reason if it is missing."""
    if settings.atmosphere is None:
        raise ConfigError(f"the key atmosphere is missing: {reason}.", path="atmosphere")
    return settings.atmosphere


def convert_mas_to_nm(settings: FileSection, mas: float, key: str) -> float:
    """Convert an angle of the file [mas] to a wavefront [nm rms]."""
    reason = f"{key} is in mas, and a wavefront in nm needs telescope.diameter_m"
    telescope = require_telescope(settings, f"{reason}. Give it, or the value in nm")
    return mas * nm_per_mas(telescope.diameter_m)


def build_atmosphere(settings: FileSection) -> Atmosphere | None:
    """Build the atmosphere of a configuration, None if it has none."""
    air = settings.atmosphere
    if air is None:
        return None
    telescope = require_telescope(
        settings, "the turbulence of atmosphere is that over its diameter"
    )
    weather = {name: getattr(air.per_sample, name) for name in WEATHER}
    rest = air.model_dump(exclude=set(WEATHER))
    return Atmosphere(diameter_m=telescope.diameter_m, **rest, **weather)
