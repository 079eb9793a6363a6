"""Configurations that are written, and read again."""

import re
from dataclasses import astuple, dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.configs import write_config
from support.plants import ROOT
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.config.schema import FileSection
from lbt_synth.config.write import RAISED, config_text, identified_config, require_writable_facts
from lbt_synth.errors import ProblemError
from lbt_synth.identification.accelerometers import transfers
from lbt_synth.identification.fit.identified_model import IdentifiedLine

RATE = 1000.0
ERRORS = {"frequency_error_hz": 0.01, "damping_error": 0.0004, "rms_error_nm": 1.5}
Line = partial(IdentifiedLine, kind="line", resolved=True, prominence=1.0, evidence=1.0, **ERRORS)
Model = partial(lbt.identification.IdentifiedModel, frame_rate_hz=RATE, delay_frames=2.0)


@dataclass(frozen=True, kw_only=True)
class Axis:
    """What a configuration takes of an identified axis."""

    turbulence: lbt.models.ARModel
    parts: tuple = ()
    noise_nm: float = 15.5
    noise_error_nm: float = 0.12
    sensor_gain: float = 1.0
    sensor_gain_error: float = 0.0


def ar(*coefficients, driving):
    return lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=RATE)


TIP = Axis(
    turbulence=ar(1.9960123456789, -0.99602, driving=0.123456789012345),
    parts=(
        Line(frequency_hz=20.123456789, damping=0.0051, rms_nm=300.0),
        Line(frequency_hz=47.0, damping=0.01, rms_nm=40.0),
    ),
    sensor_gain=0.83,
    sensor_gain_error=0.011,
)
TILT = Axis(
    turbulence=ar(0.9899, driving=31.0),
    parts=(Line(frequency_hz=13.7, damping=0.02, rms_nm=120.0),),
    noise_nm=9.25,
    sensor_gain=0.71,
    sensor_gain_error=float("nan"),
)
TWO = Model(axes=(TIP, TILT))
ONE_AXIS = Model(axes=(replace(TIP, sensor_gain=1.0),))
SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
)


def save_identified(tmp_path, model, **options):
    return write_config(tmp_path, config_text(*identified_config(model, **options)))


def load_identified(tmp_path, model, **options):
    return lbt.load_config(save_identified(tmp_path, model, **options))


def test_the_examples_are_written_as_they_are(tmp_path):
    for name in ("lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"):
        before = lbt.load_config(ROOT / "examples" / name)
        after = lbt.load_config(write_config(tmp_path, config_text(before.settings)))
        assert after.settings == before.settings
        assert after.settings.model_fields_set == before.settings.model_fields_set
        np.testing.assert_array_equal(after.plant.A, before.plant.A)
        assert after.truth.vibrations == before.truth.vibrations


positive, finite = st.floats(0.1, 100.0), st.floats(-1e4, 1e4)


@settings(max_examples=15)
@given(
    noise=positive | st.lists(positive, min_size=1, max_size=3),
    a=st.lists(finite, min_size=1, max_size=5),
    angle=finite,
    frequency=positive,
    frames=st.integers(2, 10**9),
    scale=st.none() | positive,
    many=st.booleans(),
)
def test_whatever_is_set_is_read_again(noise, a, angle, frequency, frames, scale, many):
    line = {"direction_deg": angle, "frequency_hz": frequency, "damping": 0.1, "rms_nm": frequency}
    ar = {"kind": "ar", "coefficients": a, "driving_rms_nm": frequency}
    sections = {
        "version": 1,
        "atmosphere": {"seeing_arcsec": frequency, "outer_scale_m": scale, "wind_speed_m_s": 9.0},
        "sensor": {"noise_nm": noise, "matrix": [a, a]},
        "loop": {"frame_rate_hz": frequency},
        "model": {"turbulence": [ar, {"kind": "ar1"}] if many else ar, "vibrations": [line]},
        "truth": {"vibrations": "model" if many else []},
        "simulation": {"frames": frames},
    }
    settings = FileSection.model_validate(sections)
    text = config_text(settings, {"loop.frame_rate_hz": "a # comment: [odd] ' \" é"})
    assert "odd" in text  # config_text reads it again, and refuses what has changed


DRIFT = Line(frequency_hz=18.0, damping=300.0, rms_nm=50.0)  # refused after the fit
BUMP = Line(frequency_hz=42.0, damping=0.17, rms_nm=30.0, sections=4)
CALM = Model(axes=(replace(TIP, parts=()), replace(TILT, parts=())))
WIDE = replace(ONE_AXIS, axes=(replace(TIP, parts=(DRIFT, BUMP)),))
MOVED = replace(TWO, mirror=SHELL, delay_frames=2.4)


@pytest.mark.parametrize("model", [TWO, ONE_AXIS, MOVED, CALM, WIDE])
def test_what_was_identified_is_what_is_read(tmp_path, model):
    config = load_identified(tmp_path, model)
    plant, truth, axes, n = config.plant, config.truth, model.axes, len(model.axes)
    assert (config.atmosphere, config.imaging.diameter_m) == (None, None)
    assert (plant.hardware.modes, plant.hardware.delay_frames) == (n, model.delay_frames)
    mirrors = plant.hardware.mirror, model.mirror
    assert mirrors == (None, None) or astuple(mirrors[0]) == astuple(mirrors[1])
    gains, noise = ([getattr(a, key) for a in axes] for key in ("sensor_gain", "noise_nm"))
    np.testing.assert_array_equal(plant.hardware.sensor, np.diag(gains))
    for ours, axis in zip(plant.turbulence, axes, strict=True):  # all digits
        np.testing.assert_array_equal(ours.coefficients, axis.turbulence.coefficients)
        assert ours.driving_rms_nm == axis.turbulence.driving_rms_nm
    np.testing.assert_allclose(np.sqrt(np.diag(plant.R)), noise, rtol=1e-14)
    facts = attrgetter("frequency_hz", "damping", "rms_nm", "sections")
    lines = [(tuple(np.eye(n)[i]), facts(line)) for i in range(n) for line in axes[i].parts]
    assert [(made.direction, facts(made)) for made in plant.vibrations] == lines
    assert truth.turbulence_per_mode(n) == plant.turbulence
    assert truth.noise_per_measurement(n).tolist() == noise
    assert (truth.vibrations, truth.sensor_gain) == (plant.vibrations, 1.0)
    assert lbt.kalman(plant).certificate.passed


def test_a_line_of_both_axes_is_written_once_with_its_direction(tmp_path):
    angle = np.radians(-34.2)
    along = {"direction": (np.cos(angle), np.sin(angle)), "direction_error_deg": 0.8}
    line = Line(frequency_hz=31.0, damping=0.004, rms_nm=60.0, **along)
    share = replace(line, rms_nm=60 * np.cos(angle))  # of tip: no line of its own
    model = replace(TWO, axes=(replace(TIP, parts=(share, *TIP.parts)), TILT), shared=(line,))
    file = save_identified(tmp_path, model)
    *_, shared = made = lbt.load_config(file).plant.vibrations
    assert [one.frequency_hz for one in made] == [20.123456789, 47.0, 13.7, 31.0]
    assert shared.direction == pytest.approx(line.direction, abs=1e-15)
    assert shared.rms_nm == 60
    (row,) = [row for row in file.read_text().splitlines() if "direction_deg" in row]
    assert float(row.split("#")[0].split(":")[1]) == pytest.approx(-34.2)
    assert row.endswith("# standard error 0.8 degrees")


def test_standard_errors_stand_beside_their_numbers(tmp_path):
    text = save_identified(tmp_path, TWO, title="Night of tests.\nSecond line.").read_text()
    assert text.startswith("# Night of tests.\n# Second line.\nversion: 1\n")
    rows = {row.split(":")[0].strip(): row for row in text.splitlines() if re.search(":.*#", row)}
    assert "[15.5, 9.25]" in rows["noise_nm"]
    assert rows["noise_nm"].endswith("# standard error 0.12, 0.12 nm")
    assert rows["sensor_gain"].endswith("# standard error 0.011, not known")
    for words in ("20.123456789 ", "error 0.01 Hz", "error 0.0004", "error 1.5 nm"):
        assert words in text
    # a gain of 1 that was not estimated is not worth a key
    assert "sensor_gain" not in save_identified(tmp_path, ONE_AXIS).read_text()
    camera = {"diameter_m": 8.22, "obstruction": 0.11, "wavelength_um": 1.65}
    imaging = load_identified(tmp_path, TWO, **camera, other_modes_strehl=0.8).imaging
    stated = camera | {"other_modes": 0.8}
    assert {name: getattr(imaging, name) for name in stated} == stated


@pytest.mark.parametrize(("age", "delay"), [(0, 1.0), (4, 5.0), (-3, 2.0), (500, 2.0)])
def test_accelerometers_that_show_lines_become_a_sensor(tmp_path, age, delay):
    """One channel shows the second line; the other adds nothing. A clock that is off gets age 1."""
    motion = {"motion_nm_per_nm": 1.5, "motion_error_nm_per_nm": 0.02}
    phase = {"phase_deg": -170.25, "phase_error_deg": 0.5, "coherence": 0.9, "chance": 1e-9}
    row = transfers.TransferRow(
        channel="m1", line=1, frequency_hz=47.0, useful=True, **motion, **phase
    )
    found = transfers.AccelerometerTransfers(
        transfers=(row, replace(row, channel="m2", line=0, useful=False)),
        channels=tuple(
            transfers.ChannelRow(channel=m, noise_m_s2=2e-4, verdict="") for m in ("m1", "m2")
        ),
        shift_frames=age - 1,
        shift_error_frames=0.1,
        age_frames=age,
    )
    path = save_identified(tmp_path, TWO, accelerometers=found)
    text, plant = path.read_text(), lbt.load_config(path).plant
    (sensor,) = plant.hardware.suite.sensors
    assert (sensor.channels, sensor.delay_frames) == (("m1",), delay)
    assert sensor.noise_m_s2.tolist() == [2e-4]
    assert [*map(len, plant.motions)] == [0, 1, *[0] * (len(plant.motions) - 2)]
    seen = plant.motions[1]["m1"]
    assert (seen.size, seen.phase_deg) == (1.5, -170.25)
    assert "standard error 0.02" in text
    assert ("give the real delay" in text) == (age in (-3, 500))
    # readings of the frame itself have not ended when a loop of less than two frames acts
    assert found.loop_age(1.5) == (age if 0 < age < 100 else 1)


def test_what_is_less_than_a_configuration_holds_is_raised_to_its_least():
    parts = (Line(frequency_hz=3, damping=0.1, rms_nm=0.0), *TIP.parts)
    model = Model(axes=(replace(TIP, noise_nm=2e-4, parts=parts),))
    settings, comments = identified_config(model)
    raised = settings.sensor.noise_nm, settings.model.vibrations[0].rms_nm
    assert raised == ([1e-3], 1e-3)
    assert comments["sensor.noise_nm"] == f"{RAISED}, from 0.0002 nm"
    assert comments["model.vibrations[0].rms_nm"] == f"{RAISED}, from 0 nm"


def test_what_no_configuration_can_hold():
    wanted = {"frame_rate_hz": 500.0, "delay_frames": None}  # asked before a fit
    facts, identified = partial(require_writable_facts, 1), partial(identified_config, TWO)
    settings, _ = identified_config(ONE_AXIS)
    remarks = ({"loop.frame_rate_hz": comment} for comment in ("\x00", "a\nb: 1"))
    facts(**wanted)
    rows = [
        *((partial(config_text, settings, remark), "read again") for remark in remarks),
        (partial(identified_config, Model(axes=())), "one or two axes; got a model of 0"),
        (partial(identified, obstruction=0.1), "diameter_m, which is missing"),
        (partial(identified, wavelength_um=np.nan), "imaging.wavelength_um"),
        (partial(identified_config, replace(TWO, delay_frames=None)), "delay_frames"),
        (partial(identified_config, Model(axes=(replace(TIP, noise_nm=-1.0),))), "sensor.noise_nm"),
        (partial(facts, **wanted, obstruction=0.1), "diameter_m, which is mi"),
        (partial(facts, 500.0, 1e9), "loop.delay_frames"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)
