"""Disturbances in words."""

import numpy as np

import lbt_synth as lbt
from lbt_synth.models.disturbance_facts import disturbance_facts
from lbt_synth.storage.display_unit import own_display_unit, show_in

SLOW = lbt.models.ARModel(coefficients=[0.6], driving_rms_nm=8.0, frame_rate_hz=1000)
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)


def line(frequency_hz, rms_nm):
    return lbt.Vibration(frequency_hz=frequency_hz, damping=0.01, rms_nm=rms_nm)


def test_what_axes_have_in_common_is_said_once():
    facts = disturbance_facts([SLOW, SLOW, AIR, None], (), np.array([15.5, 15.5, 12.0]))
    assert facts.turbulence == "AR1 10 nm, Atmosphere 591.6 nm, none"
    assert facts.noise_nm == "15.5 nm, 12 nm"
    assert facts.vibrations == ""


def test_the_strongest_vibrations_are_listed_by_frequency():
    lines = [line(50, 3.0), line(20, 100.0), *(line(60 + i, 1.0 + i) for i in range(6))]
    drift = lbt.models.DriftingVibration(start_hz=17, end_hz=23, duration_s=60, rms_nm=200)
    facts = disturbance_facts([None], (*lines, drift), np.array(0.0), 0.5)
    assert facts.vibrations.startswith("200 nm at 17 Hz, 100 nm at 20 Hz, ")
    assert facts.vibrations.endswith(", 3 more")
    assert facts.sensor_gain == 0.5


def test_sizes_are_in_the_unit_that_is_shown():
    with own_display_unit():
        show_in("mas", 10.0)
        facts = disturbance_facts([SLOW], [line(20, 100.0)], np.array(15.0))
    assert [facts.turbulence, facts.vibrations, facts.noise_nm] == [
        "AR1 1 mas",
        "10 mas at 20 Hz",
        "1.5 mas",
    ]
