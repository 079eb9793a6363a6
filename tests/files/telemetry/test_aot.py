"""Telemetry in the AOT standard, judged by the standard's own package."""

import dataclasses
import functools
import importlib
import json
import sys

import numpy as np
import pytest
from astropy.io import fits
from support.refusals import refused
from support.telemetry import full, same

import lbt_synth as lbt
from lbt_synth.errors import OutputError, TelemetryError
from lbt_synth.files import load_telemetry, save_telemetry
from lbt_synth.files.telemetry.aot import lost_fields

pytestmark = pytest.mark.e2e


class Later:
    """The package, imported when a test uses it: without it these tests fail, not the collection."""

    def __getattr__(self, name):
        try:
            return getattr(importlib.import_module("aotpy"), name)
        except ImportError as error:  # what looks through this module, as doctest does, goes on
            raise AttributeError('these tests need aotpy: pip install ".[aot]"') from error


aotpy = Later()
ROUNDING = 1e-14  # lengths change their unit on the way
TEXTS = ["'/", "''/ '&", "a" * 60 + "'" * 9 + " / & ", "&" * 200, '\\"' * 90]  # FITS mangles them


def strictly_read(path):
    """Read as aotpy reads, any deviation but our one card an error."""
    level = aotpy.io.fits.AOTFITSErrorLevel.WARNING
    options = {"exception_level": level, "externals": "disallow", "memmap": False}
    return aotpy.AOTFITSReader(path, **options).get_system()


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({}, ()),
        ({"diameter_m": None}, ("obstruction",)),  # which needs a diameter
        *(({"metadata": {text: text, "&/'": "'/", "long": "x' /" * 60}}, ()) for text in TEXTS),
    ],
)
def test_what_the_standard_carries_comes_back(tmp_path, changes, missing):
    seen = full(**changes)
    back = load_telemetry(save_telemetry(tmp_path / "t.aot.fits", seen))
    lost = lost_fields(seen)
    assert lost == ("residual_nm", "total_nm", *missing)
    assert same(seen, back, but=lost, rtol=ROUNDING)
    assert all(getattr(back, name) is None for name in lost)
    assert not lost_fields(back)
    again = load_telemetry(save_telemetry(tmp_path / "u.aot.fits", back))
    assert same(back, again, rtol=ROUNDING)


def test_the_file_says_what_the_telemetry_says(tmp_path):
    seen = full()
    system = strictly_read(save_telemetry(tmp_path / "t.aot.fits", seen))
    telescope, (star,), (sensor,) = system.main_telescope, system.sources, system.wavefront_sensors
    (mirror,), (loop,), (card,) = system.wavefront_correctors, system.loops, system.metadata
    ours = json.loads(card.value)
    kinds = (aotpy.NaturalGuideStar, aotpy.Pyramid, aotpy.TipTiltMirror, aotpy.ControlLoop)
    assert all(map(isinstance, (star, sensor, mirror, loop), kinds))
    for written, expected in (
        ((id(sensor.source), id(mirror.telescope)), (id(star), id(telescope))),
        ((id(loop.input_sensor), id(loop.commanded_corrector)), (id(sensor), id(mirror))),
        ((system.ao_mode, system.strehl_wavelength), ("SCAO", pytest.approx(2.2e-6))),
        ((telescope.enclosing_diameter, telescope.inscribed_diameter), (8.22, 8.22)),
        (telescope.obstruction_diameter, pytest.approx(0.11 * 8.22)),
        ((sensor.n_sides, sensor.dimensions, sensor.n_valid_subapertures), (4, 1, 3)),
        ((sensor.measurements.unit, sensor.optical_gain.data.tolist()), ("pixel", [0.358])),
        (sensor.measurements.data.tolist(), seen.measurements[:, None].tolist()),
        ((loop.framerate, loop.delay, loop.closed), (800, 2.25, True)),
        ((loop.commands.unit, loop.modal_coefficients), ("m", None)),
        (loop.commands.data, pytest.approx(1e-9 * seen.commands, rel=1e-14, abs=0)),
        (loop.commands_to_modes.data.tolist(), seen.influence_matrix.tolist()),
        (loop.time.frame_numbers, list(range(6))),
        (loop.time.timestamps, pytest.approx(seen.times_s, rel=1e-14, abs=0)),
        (loop.modes_to_measurements.data.tolist(), seen.interaction_matrix[:, None].tolist()),
        (card.key, "LBTSYNTH"),
        (ours["mirror"], dataclasses.asdict(seen.mirror)),
        (ours["mirror_taps"], seen.mirror_taps.tolist()),
        (ours["metadata"], dict(seen.metadata)),
    ):
        assert written == expected
    assert "y(k) = sensor_gain S phi_res(k-1) + noise(k)" in system.config
    assert "with the mirror taps c" in system.config


def test_aotpy_finds_nothing_wrong(tmp_path, capsys):
    least = lbt.files.Telemetry(frame_rate_hz=1.0, commands=[[1.0]], measurements=[[2.0]])
    matrices = {"commands": np.ones((6, 5)), "influence_matrix": np.ones((2, 5))}
    wide = full(**matrices)
    for name, seen in (("full", full()), ("least", least), ("wide", wide)):
        path = save_telemetry(tmp_path / f"{name}.aot.fits", seen)
        mirror = strictly_read(path).wavefront_correctors[0]
        aotpy.verify_file(path)
        (said,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("["))
        assert said.endswith("non-AOT keywords: ['LBTSYNTH']. (Error level: PEDANTIC)")
        with fits.open(path, checksum=True) as units:
            assert all("DATASUM" in unit.header and unit.verify_datasum() == 1 for unit in units)
    assert isinstance(mirror, aotpy.DeformableMirror)
    assert mirror.n_valid_actuators == 5


def test_the_header_says_which_layout_it_is(tmp_path):
    """Not the name: an AOT file may be called anything that ends in .fits."""
    seen = full()
    aot = save_telemetry(tmp_path / "t.aot.fits", seen)
    assert load_telemetry(aot.rename(tmp_path / "t.fits")).residual_nm is None
    own = save_telemetry(tmp_path / "own.fits", seen)
    own.rename(tmp_path / "own.aot.fits")
    assert same(seen, load_telemetry(tmp_path / "own.aot.fits"))


def foreign(tmp_path, *, edit=lambda system: None):
    """Write a Shack-Hartmann loop, as an observatory might, and with no card of ours."""
    rng = np.random.default_rng(0)
    system = aotpy.AOSystem(ao_mode="SCAO", name="NAOMI", strehl_ratio=0.4)
    system.main_telescope = aotpy.MainTelescope("AT", inscribed_diameter=1.8)
    star = aotpy.NaturalGuideStar("NGS")
    clock = aotpy.Time("t", timestamps=[1.5e9, 1.5e9 + 0.002, 1.5e9 + 0.004])
    sensor = aotpy.ShackHartmann(
        "WFS",
        source=star,
        n_valid_subapertures=3,
        measurements=aotpy.Image("slopes", rng.standard_normal((3, 2, 3)), unit="pix", time=clock),
        optical_gain=aotpy.Image("og", np.array([0.5, 0.6, 0.7])),
    )
    mirror = aotpy.DeformableMirror("DM", telescope=system.main_telescope, n_valid_actuators=4)
    commands = aotpy.Image("commands", 1e-6 * rng.standard_normal((3, 4)), time=clock)
    ends = {"input_sensor": sensor, "commanded_corrector": mirror}
    loop = aotpy.ControlLoop("HO loop", **ends, time=clock, commands=commands)
    system.sources, system.wavefront_sensors = [star], [sensor]
    system.wavefront_correctors, system.loops = [mirror], [loop]
    edit(system)
    path = tmp_path / "foreign.fits"
    system.write_to_file(path, overwrite=True)
    return path, system


def with_loop(fields):
    """Set attributes of the first loop, or of what it refers to, by their paths."""

    def edit(system):
        for path, value in fields.items():
            *place, name = path.split(".")
            setattr(functools.reduce(getattr, place, system.loops[0]), name, value)

    return edit


NO_CLOCK = dict.fromkeys(("time", "commands.time", "input_sensor.measurements.time"))


def test_a_file_of_somebody_else(tmp_path):
    path, system = foreign(tmp_path)
    seen = load_telemetry(path)
    loop = system.loops[0]
    assert np.allclose(seen.commands, 1e9 * loop.commands.data)  # metres are the standard's unit
    assert np.array_equal(seen.measurements, loop.input_sensor.measurements.data.reshape(3, 6))
    assert (seen.measurement_unit, seen.command_unit) == ("pix", "nm")
    assert (seen.delay_frames, seen.diameter_m, seen.obstruction) == (None, 1.8, None)
    numbers = {"frame_rate_hz": pytest.approx(500, rel=1e-4), "sensor_gain": pytest.approx(0.6)}
    assert {name: getattr(seen, name) for name in numbers} == numbers  # the rate of time stamps
    assert (seen.metadata["name"], seen.metadata["strehl"]) == ("NAOMI", 0.4)
    assert "another program" in seen.metadata["timing"]


def test_modal_coefficients_are_the_measurements(tmp_path):
    """The response of the modes to themselves, behind the reconstructor, goes with them."""
    rng = np.random.default_rng(1)
    back, response, modes = rng.random((2, 2, 3)), rng.random((3, 2, 2)), rng.random((3, 2))
    images = {
        "modal_coefficients": aotpy.Image("modes", modes, unit="um"),
        "measurements_to_modes": aotpy.Image("back", back),
        "modes_to_measurements": aotpy.Image("response", response),
    }
    seen = load_telemetry(foreign(tmp_path, edit=with_loop(images))[0])
    assert (seen.measurement_unit, seen.modes) == ("nm", 2)
    assert np.allclose(seen.measurements, 1e3 * modes)
    assert np.allclose(seen.interaction_matrix, np.einsum("mds,sdn->mn", back, response))


def two_loops(system):
    """Loops as CIAO has them: a mirror of many actuators, and tip and tilt by the same sensor."""
    (loop,), (mirror,) = system.loops, system.wavefront_correctors
    ends = {"input_sensor": loop.input_sensor, "commanded_corrector": mirror}
    offload = aotpy.OffloadLoop("offload", input_corrector=mirror, commanded_corrector=mirror)
    steering = aotpy.TipTiltMirror("ITTM", telescope=system.main_telescope)
    rng = np.random.default_rng(2)
    tip_tilt = aotpy.ControlLoop(
        "TT loop",
        **ends | {"commanded_corrector": steering},
        time=loop.time,
        commands=aotpy.Image("positions", 1e-6 * rng.standard_normal((3, 2)), time=loop.time),
        control_matrix=aotpy.Image("CM", rng.standard_normal((2, 2, 3))),
        measurements_to_modes=aotpy.Image("S2M", rng.standard_normal((5, 2, 3))),
        framerate=500.0,
    )
    system.wavefront_correctors = [mirror, steering]
    system.loops = [offload, loop, aotpy.ControlLoop("no series", **ends), tip_tilt]


def test_a_loop_is_chosen_by_name_or_number(tmp_path):
    path, system = foreign(tmp_path, edit=two_loops)
    first, seen = load_telemetry(path), load_telemetry(path, loop="TT loop")
    assert [each.metadata["aot_loop"] for each in (first, seen)] == ["HO loop", "TT loop"]
    assert first.metadata["aot_loops"] == "HO loop, TT loop"
    assert same(first, load_telemetry(path, loop=0))
    tip_tilt = system.loops[-1]
    assert np.allclose(seen.commands, 1e9 * tip_tilt.commands.data)
    slopes, control = tip_tilt.input_sensor.measurements.data, tip_tilt.control_matrix.data
    assert np.allclose(seen.measurements, 1e9 * np.einsum("mds,tds->tm", control, slopes))
    assert np.array_equal(lbt.load_record(path, loop="TT loop").measurements, seen.measurements)
    assert all(same(seen, load_telemetry(path, loop=number)) for number in (1, "1"))
    words = r"has the control loops HO loop, TT loop, from 0; got 2\."
    refused(lambda: load_telemetry(path, loop=2), TelemetryError, words)


def test_a_detector_has_a_rate_and_time_stamps_that_are_all_zero_are_none(tmp_path):
    detector = aotpy.Detector("D", frame_rate=640.0)
    rated, unset = (
        load_telemetry(foreign(tmp_path, edit=with_loop(fields))[0])
        for fields in (
            {"input_sensor.detector": detector},
            {"time.timestamps": [0.0, 0.0, 0.0], "framerate": 500.0},
        )
    )
    assert (rated.frame_rate_hz, unset.times_s) == (640, None)


def card_of_ours(value):
    return lambda system: system.metadata.append(aotpy.Metadatum("LBTSYNTH", value))


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (with_loop({"commands": None}), "has no control loop with commands and measurements"),
        (with_loop(NO_CLOCK), "the frame rate is missing"),
        (with_loop({"time.timestamps": [1.0, 1.0, 1.0]}), "the frame rate is missing"),
        (with_loop({"commands.data": np.ones((2, 4))}), "must have 2 frames to match commands"),
        (card_of_ours("{"), "inconsistent"),
        (card_of_ours("{}"), "metadata is missing"),
        (card_of_ours(3), "inconsistent"),
    ],
)
def test_files_that_do_not_fit(tmp_path, edit, text):
    path, _ = foreign(tmp_path, edit=edit)
    assert "\n" not in str(refused(lambda: load_telemetry(path), TelemetryError, text))


def test_a_file_of_another_version_or_that_refers_to_others_is_not_followed(tmp_path):
    """aotpy would open the file, the address, or a window that asks for it."""

    other, marked = tmp_path / "else.fits", tmp_path / "t.fits"
    fits.ImageHDU(np.ones((3, 4))).writeto(other)
    path, _ = foreign(tmp_path, edit=with_loop({"commands": aotpy.io.FITSFileImage(other, 1)}))
    refused(lambda: load_telemetry(path), TelemetryError, "External image")
    fits.PrimaryHDU(header=fits.Header({"AOT-VERS": "9.0.0"})).writeto(marked)  # only the mark
    refused(lambda: load_telemetry(marked), TelemetryError, "Unknown version '9.0.0'")


def test_without_aotpy_it_says_what_to_install(tmp_path, monkeypatch):
    path = save_telemetry(tmp_path / "t.aot.fits", full())
    monkeypatch.setitem(sys.modules, "aotpy", None)
    out, advice = tmp_path / "u.aot.fits", r'pip install "lbt-synth\[aot\]"'
    refused(lambda: load_telemetry(path), TelemetryError, advice)
    refused(lambda: save_telemetry(out, full()), OutputError, advice)
    assert not out.exists()
    own = save_telemetry(tmp_path / "t.fits", full())  # needs no extra
    assert load_telemetry(own).sensor_gain == 0.358
