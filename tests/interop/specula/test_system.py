"""Systems of an end-to-end simulation."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"diameter_m": 0}, "diameter_m"),
        ({"seeing_arcsec": float("nan")}, "seeing_arcsec"),
        ({"obstruction": 1.0}, "obstruction"),
        ({"read_noise_electrons": -1}, "read_noise_electrons"),
        ({"modes": 2}, "modes"),
        ({"pixels": 61}, "pixels must be even"),
        ({"pixels": 20}, "pixels must be even"),
        ({"pixels": 2000}, "pixels must be even"),
        ({"wind_direction_deg": float("inf")}, "wind_direction_deg"),
        ({"hardware": lbt.LoopHardware(frame_rate_hz=800, modes=3)}, "two modes"),
        (
            {"hardware": lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=2 * np.eye(2))},
            "sensor_matrix",
        ),
    ],
)
def test_systems_that_are_refused(setup, change, match):
    with pytest.raises(ProblemError, match=match):
        replace(setup.system, **change)


def test_a_phase_screen_is_longer_than_the_way_of_the_wind(setup):
    system = setup.system
    for frames in (10, 2000, 20000):
        length = system.screen_pixels(frames) * system.pixel_m
        assert length > frames / 800 * 20 + 2 * 8.22
        assert length > 6 * 22


def test_seeing_at_another_wavelength(setup):
    system = replace(setup.system, seeing_wavelength_um=2.2, seeing_arcsec=0.5)
    assert system.reference_seeing_arcsec == pytest.approx(0.5 * (2.2 / 0.5) ** 0.2)
