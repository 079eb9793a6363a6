"""Telemetry: what it takes, what its files keep, and damage of every kind."""

from __future__ import annotations

import dataclasses
import json
import os

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.files.telemetry import native_layout
from lbt_synth.files.telemetry.aot import lost_fields
from lbt_synth.files.telemetry.conventions import CONVENTION
from lbt_synth.files.telemetry.native_layout import LAYERS
from lbt_synth.storage import array_file as archive

ENDINGS = ("fits", "npz")


SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=150, sampling_hz=24_000, ramp_samples=3
)


def full(*, frames=6, with_slopes=True, random=0, **changes):
    """Telemetry with everything in it: 2 modes, 2 commands, 8 slopes."""
    rng = np.random.default_rng(random)
    sensed = 8 if with_slopes else 2
    fields = {
        "frame_rate_hz": 800.0,
        "delay_frames": 2.25,
        "mirror": SHELL,
        "commands": rng.standard_normal((frames, 2)),
        "measurements": rng.standard_normal((frames, 2)),
        "residual_nm": rng.standard_normal((frames, 2)),
        "total_nm": rng.standard_normal((frames, 2)),
        "slopes": rng.standard_normal((frames, sensed)) if with_slopes else None,
        "interaction_matrix": rng.standard_normal((sensed, 2)),
        "reconstructor": rng.standard_normal((2, sensed)),
        "influence_matrix": rng.standard_normal((2, 2)),
        "mode_maps": rng.standard_normal((2, 5, 4)),
        "psf": rng.random((7, 9)),
        "psf_pixel_mas": 13.5,
        "imaging_wavelength_um": 2.2,
        "strehl": 0.83,
        "times_s": 1.7e9 + np.cumsum(rng.uniform(0.001, 0.002, frames)),
        "subaperture_axes": 2,
        "slope_unit": "pixel",
        "sensor_gain": 0.358,
        "controller": lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.4).controller,
        "controller_name": "integrator",
        "controller_digest": "ab" * 32,
        "integrator_gains": [0.4, 0.4],
        "diameter_m": 8.22,
        "obstruction": 0.11,
        "seed": 7,
        "name": "LBT, côté gauche",
        "metadata": {"target": "HD 1'0\n", "airmass": 1.2, "binning": 1, "night": True, "é": ""},
    }
    return lbt.files.Telemetry(**{**fields, **changes})


def same(one, other, *, but=(), rtol=0.0):
    """Whether two telemetries hold the same, field by field."""
    for field in dataclasses.fields(lbt.files.Telemetry):
        if field.name in but:
            continue
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, lbt.models.PositionLoop):
            assert dataclasses.asdict(a) == dataclasses.asdict(b)
        elif isinstance(a, lbt.Controller):
            for name in "ABCD":
                assert np.array_equal(getattr(a, name), getattr(b, name))
            assert a.dt_s == b.dt_s
        elif isinstance(a, np.ndarray):
            assert a.shape == b.shape, field.name
            assert np.allclose(a, b, rtol=rtol, atol=0), field.name
            assert not b.flags.writeable
        elif isinstance(a, float) and rtol:
            assert b == pytest.approx(a, rel=rtol), field.name
        else:
            assert a == b, field.name
            assert type(a) is type(b), field.name
    return True


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("slopes", [True, False])
def test_round_trip_keeps_every_bit(tmp_path, ending, slopes):
    seen = full(with_slopes=slopes)
    assert same(
        seen, lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / f"t.{ending}", seen))
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_least_telemetry(tmp_path, ending):
    seen = lbt.files.Telemetry(frame_rate_hz=1.0, commands=[[1.0]], measurements=[[2.0]])
    assert same(
        seen, lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / f"t.{ending}", seen))
    )


finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
words = st.text(max_size=30)


@st.composite
def telemetries(draw):
    frames, m, q = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 3))

    def series(columns):
        values = draw(st.lists(finite, min_size=frames * columns, max_size=frames * columns))
        return np.reshape(values, (frames, columns))

    optional = {
        "delay_frames": st.floats(0, 1000),
        "strehl": st.floats(0, 1),
        "sensor_gain": st.floats(1e-300, 1e300),
        "seed": st.integers(0, 2**70),
        "controller_name": words,
        "diameter_m": st.floats(0.1, 50),
    }
    fields = {k: draw(s) for k, s in optional.items() if draw(st.booleans())}
    metadata = st.dictionaries(
        st.text(min_size=1, max_size=20),
        st.one_of(words, st.booleans(), st.integers(-(2**70), 2**70), finite),
        max_size=4,
    )
    return lbt.files.Telemetry(
        frame_rate_hz=draw(st.floats(1e-3, 1e6)),
        commands=series(m),
        measurements=series(q),
        total_nm=series(2) if draw(st.booleans()) else None,
        name=draw(words),
        metadata=draw(metadata),
        **fields,
    )


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seen=telemetries(), ending=st.sampled_from(ENDINGS))
def test_any_telemetry_comes_back(tmp_path, seen, ending):
    assert same(
        seen, lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / f"t.{ending}", seen))
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_float32_rounds_series_and_nothing_else(tmp_path, ending):
    seen = full(frames=5000)
    path = lbt.files.save_telemetry(tmp_path / f"t.{ending}", seen, precision="float32")
    back = lbt.files.load_telemetry(path)
    series = [
        layer.field for layer in LAYERS.values() if layer.is_series and layer.field != "times_s"
    ]
    assert same(seen, back, but=series)
    for name in series:
        assert np.array_equal(getattr(back, name), getattr(seen, name).astype(np.float32))
    exact = lbt.files.save_telemetry(tmp_path / f"exact.{ending}", seen)
    assert path.stat().st_size < 0.75 * exact.stat().st_size


def test_float32_refuses_what_it_cannot_hold(tmp_path):
    seen = lbt.files.Telemetry(frame_rate_hz=1.0, commands=[[1e39]], measurements=[[2.0]])
    with pytest.raises(
        lbt.errors.ProblemError, match="commands has values beyond the range of float32"
    ):
        lbt.files.save_telemetry(tmp_path / "t.fits", seen, precision="float32")
    with pytest.raises(lbt.errors.ProblemError, match="precision must be one of float64, float32"):
        lbt.files.save_telemetry(tmp_path / "t.fits", seen, precision="half")
    assert not list(tmp_path.iterdir())


def test_the_fits_file_explains_itself(tmp_path):
    """Read with astropy alone: names, units, axes, timing."""
    seen = full()
    with fits.open(lbt.files.save_telemetry(tmp_path / "t.fits", seen)) as units:
        header = units[0].header
        assert units[0].data is None
        assert header["LBTTELEM"] == 1
        assert (header["RATE_HZ"], header["DELAY"], header["SENSGAIN"]) == (800, 2.25, 0.358)
        assert (header["DIAMETER"], header["STREHL"], header["WAVELEN"]) == (8.22, 0.83, 2.2)
        assert header["TIMING"] == seen.convention
        assert np.array_equal(units["MIRROR_TAPS"].data, seen.mirror_taps)
        assert np.array_equal(units["COMMANDS"].data, seen.commands)
        assert np.array_equal(units["CTRL_A"].data, seen.controller.A)
        assert units["COMMANDS"].header["BUNIT"] == "nm"
        assert units["SLOPES"].header["BUNIT"] == "pixel"
        axes = units["SLOPES"].header
        assert (axes["CTYPE2"], axes["NAXIS2"]) == ("FRAME", 6)
        assert (axes["CTYPE1"], axes["NAXIS1"]) == ("SLOPE", 8)
        names = [unit.name for unit in units[1:]]
        assert set(LAYERS) <= set(names)
        assert names[-1] == "META"


def test_the_same_telemetry_is_the_same_file(tmp_path):
    for ending in ENDINGS:
        one = lbt.files.save_telemetry(tmp_path / f"a.{ending}", full()).read_bytes()
        assert lbt.files.save_telemetry(tmp_path / f"b.{ending}", full()).read_bytes() == one


# ---------------------------------------------------------------- timing
@pytest.mark.parametrize("delay", [1.0, 2.0, 2.25, 3.5])
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_loop_equations_hold_in_the_file_alone(tmp_path, delay, ending):
    """What the file says of timing, checked on a simulation without noise."""
    rng = np.random.default_rng(3)
    path = lbt.LoopHardware(
        frame_rate_hz=500.0,
        delay_frames=delay,
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=[[1.0, 0.2], [-0.1, 0.8]],
    )
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=500)
    truth = lbt.Truth(turbulence=slow, noise_nm=0.0, sensor_gain=0.6)
    design = lbt.integrator(path, gain=0.2)
    run = lbt.simulate(design.controller, truth, hardware=path, frames=60, cases=2, seed=5)
    lbt.files.save_telemetry(
        tmp_path / f"t.{ending}",
        lbt.files.telemetry_from_simulation(run, path, case=1, sensor_gain=0.6, design=design),
    )
    seen = lbt.files.load_telemetry(tmp_path / f"t.{ending}")
    # y(k) = g S phi_res(k-1)
    expected = seen.sensor_gain * seen.residual_nm[:-1] @ seen.interaction_matrix.T
    assert np.allclose(seen.measurements[1:], expected, atol=1e-9)
    # phi_res(k) = phi_tot(k) - N ((1-f) u(k-j) + f u(k-j-1)), d = j + 1 + f
    j, f = int(delay - 1), delay - 1 - int(delay - 1)
    u = seen.commands
    applied = (1 - f) * u[1 : len(u) - j] + f * u[: len(u) - j - 1]
    assert np.allclose(
        seen.residual_nm[j + 1 :],
        seen.total_nm[j + 1 :] - applied @ seen.influence_matrix.T,
        atol=1e-9,
    )
    # u(k) from y up to k: an integrator is u(k) = u(k-1) + gain R y(k)
    inverse = np.linalg.pinv(seen.interaction_matrix @ seen.influence_matrix)
    steps = seen.integrator_gains * (seen.measurements[1:] @ inverse.T)
    assert np.allclose(np.diff(u, axis=0), steps, atol=1e-9)
    assert (seen.seed, seen.delay_frames, seen.controller_name) == (5, delay, "integrator")
    hardware = seen.hardware
    assert np.array_equal(hardware.sensor, path.sensor)
    assert np.array_equal(hardware.influence, path.influence)
    assert np.array_equal(run.commands[1], u)


@pytest.mark.parametrize("kind", ["fits", "npz", pytest.param("aot", marks=pytest.mark.e2e)])
@pytest.mark.parametrize("delay", [2.0, 2.25])
def test_the_equation_of_a_moving_mirror_holds_in_the_file_alone(tmp_path, kind, delay):
    """phi_cor(k) = N (c0 u(k) + c1 u(k-1) + ...), as the file says, with what it holds."""
    path = lbt.LoopHardware(
        frame_rate_hz=800.0,
        delay_frames=delay,
        influence_matrix=[[1.0, 0.2], [-0.1, 0.8]],
        mirror=SHELL,
    )
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=slow, noise_nm=3.0)
    design = lbt.integrator(path, gain=0.1)
    run = lbt.simulate(design.controller, truth, hardware=path, frames=120, seed=5)
    written = lbt.files.telemetry_from_simulation(run, path, design=design)
    name = "t.aot.fits" if kind == "aot" else f"t.{kind}"
    seen = lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / name, written))
    assert "phi_cor(k) = N (c0 u(k) + c1 u(k-1)" in seen.convention
    assert "u(k-d+1)" not in seen.convention
    taps, u = seen.mirror_taps, seen.commands
    assert taps.size > 5
    corrected = sum(c * np.vstack([np.zeros((i, 2)), u[: len(u) - i]]) for i, c in enumerate(taps))
    error = run.total_nm[0] - corrected @ seen.influence_matrix.T - run.residual_nm[0]
    assert np.max(np.abs(error[taps.size :])) < 1e-9
    if kind != "aot":
        assert np.array_equal(seen.total_nm, run.total_nm[0])
    # the loop of the file is the loop that ran
    assert np.array_equal(seen.hardware.mirror_taps, path.mirror_taps)
    replayed = lbt.simulate(
        (seen.controller or design.controller), truth, hardware=seen.hardware, frames=120, seed=5
    )
    assert np.allclose(replayed.residual_nm, run.residual_nm, rtol=0, atol=1e-9)
    assert "mirror" not in lost_fields(seen)


def test_the_taps_stand_in_the_file(tmp_path):
    """For who reads it without this package: an array of FITS or NumPy, and the words."""
    seen = full()
    with fits.open(lbt.files.save_telemetry(tmp_path / "t.fits", seen)) as units:
        assert np.array_equal(units["MIRROR_TAPS"].data, seen.hardware.mirror_taps)
        assert "with the mirror taps c" in units[0].header["TIMING"]
    with np.load(lbt.files.save_telemetry(tmp_path / "t.npz", seen)) as arrays:
        assert np.array_equal(arrays["MIRROR_TAPS"], seen.hardware.mirror_taps)


def test_a_settled_mirror_leaves_the_file_as_it_was(tmp_path):
    seen = full(mirror=None)
    assert seen.convention == CONVENTION
    assert seen.mirror_taps is None
    arrays, meta = native_layout.pack(seen, "float64")
    assert "MIRROR_TAPS" not in arrays
    assert "mirror" not in meta  # what 0.1 wrote, and reads
    assert native_layout.unpack(arrays, meta).mirror is None


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda a, m: a.pop("MIRROR_TAPS"), "go together"),
        (lambda a, m: m.pop("mirror"), "go together"),
        (lambda a, m: a.update(MIRROR_TAPS=a["MIRROR_TAPS"][::-1]), "not those of its mirror"),
        (lambda a, m: m["mirror"].update(ramp_samples=2), "not those of its mirror"),
    ],
)
def test_taps_and_mirror_must_agree(edit, text):
    arrays, meta = native_layout.pack(full(), "float64")
    edit(arrays, meta)
    with pytest.raises(ValueError, match=text):
        native_layout.unpack(arrays, meta)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mirror": 3}, "expected a PositionLoop; got int"),
        ({"delay_frames": None}, "needs delay_frames"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1"),
        ({"frame_rate_hz": 790.0, "controller": None}, "whole number of samples a frame"),
    ],
)
def test_a_mirror_that_does_not_fit_is_refused(changes, text):
    with pytest.raises(lbt.errors.ProblemError, match=text):
        full(**changes)


def test_the_camera_gives_telescope_and_strehl_ratio():
    path = lbt.LoopHardware(frame_rate_hz=800)
    design = lbt.integrator(path, gain=0.5)
    shake = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=200)
    truth = lbt.Truth(turbulence=None, vibrations=(shake,))
    run = lbt.simulate(design.controller, truth, hardware=path, frames=200, cases=2)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11)
    seen = lbt.files.telemetry_from_simulation(
        run, path, case=1, imaging=camera, name="a", metadata={"b": 1}
    )
    assert seen.strehl == run.strehl(camera)[1]
    assert (seen.diameter_m, seen.obstruction, seen.imaging_wavelength_um) == (8.22, 0.11, 2.2)
    assert (seen.name, dict(seen.metadata), seen.controller) == ("a", {"b": 1}, None)
    three = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    slow = lbt.integrator(three, gain=0.5).controller
    wide = lbt.simulate(slow, lbt.Truth(turbulence=None), hardware=three, frames=5)
    assert lbt.files.telemetry_from_simulation(wide, three, imaging=camera).strehl is None


def test_telemetry_of_refuses(axis_plant):
    path = axis_plant.hardware
    design = lbt.kalman(axis_plant)
    run = lbt.simulate(design.controller, lbt.Truth(turbulence=None), hardware=path, frames=5)
    with pytest.raises(
        lbt.errors.ProblemError, match="case must be below the number of cases, 1; got 1"
    ):
        lbt.files.telemetry_from_simulation(run, path, case=1)
    with pytest.raises(lbt.errors.ProblemError, match="must be that of the simulation, at 800 Hz"):
        lbt.files.telemetry_from_simulation(run, lbt.LoopHardware(frame_rate_hz=500, modes=1))
    with pytest.raises(lbt.errors.ProblemError, match="expected a Simulation; got int"):
        lbt.files.telemetry_from_simulation(3, path)
    with pytest.raises(lbt.errors.ProblemError, match="expected a LoopHardware; got int"):
        lbt.files.telemetry_from_simulation(run, 3)
    with pytest.raises(lbt.errors.ProblemError, match="expected a Design; got Controller"):
        lbt.files.telemetry_from_simulation(run, path, design=design.controller)
    with pytest.raises(lbt.errors.DimensionError, match="interaction_matrix must have 1 row"):
        lbt.files.telemetry_from_simulation(run, lbt.LoopHardware(frame_rate_hz=800, modes=2))


def test_hardware_of_slopes_is_seen_through_the_reconstructor():
    seen = full()
    expected = seen.reconstructor @ seen.interaction_matrix
    assert np.allclose(seen.hardware.sensor, expected)
    bare = full(reconstructor=None)
    assert np.array_equal(bare.hardware.sensor, np.eye(2))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"delay_frames": None, "mirror": None}, "does not tell the delay"),
        (
            {
                "influence_matrix": None,
                "commands": np.ones((6, 3)),
                "controller": None,
                "integrator_gains": None,
            },
            "3 commands of 2 modes, and no influence_matrix",
        ),
    ],
)
def test_hardware_that_is_not_told(changes, text):
    with pytest.raises(lbt.errors.ProblemError, match=text):
        _ = full(**changes).hardware


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
        ({"delay_frames": -1}, "delay_frames must be at least 0"),
        ({"strehl": 1.1}, "strehl must be at most 1"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        ({"obstruction": 1}, "obstruction must be below 1"),
        ({"diameter_m": float("nan")}, "diameter_m must be finite"),
        ({"psf_pixel_mas": 0}, "psf_pixel_mas must be above 0"),
        ({"imaging_wavelength_um": -1}, "imaging_wavelength_um must be above 0"),
        ({"seed": 1.5}, "seed must be an integer"),
        ({"commands": [1.0, 2.0]}, "commands must be a matrix"),
        ({"commands": np.zeros((0, 2))}, "commands must have a frame and a command at least"),
        ({"commands": None}, "commands must be an array of numbers"),
        ({"measurements": None}, "measurements must be an array of numbers"),
        ({"measurements": np.zeros((5, 2))}, "measurements must have 6 rows to match commands"),
        ({"measurements": np.zeros((6, 0))}, "measurements must have a column at least"),
        ({"residual_nm": np.full((6, 2), np.nan)}, "residual_nm must be finite; got nan at index"),
        ({"slopes": np.zeros((6, 8), dtype=complex)}, "slopes must be real"),
        ({"times_s": np.zeros(6)}, "times_s must rise"),
        ({"times_s": np.zeros(5)}, "times_s must have shape"),
        ({"subaperture_axes": 3}, "subaperture_axes must divide the 8 values"),
        ({"interaction_matrix": np.ones((7, 2))}, "interaction_matrix must have 8 rows to match"),
        ({"reconstructor": np.ones((2, 7))}, "reconstructor must have 8 columns to match"),
        ({"influence_matrix": np.ones((2, 3))}, "influence_matrix must have 2 columns to match"),
        ({"influence_matrix": np.ones((3, 2))}, "number of modes must be the same everywhere"),
        ({"mode_maps": np.ones((3, 5, 4))}, "number of modes .* 3 in mode_maps"),
        ({"mode_maps": np.ones((2, 5))}, "mode_maps must be 3-D"),
        ({"psf": np.ones(4)}, "psf must be 2-D"),
        ({"psf": np.ones((0, 4))}, "psf must be 2-D and not empty"),
        ({"slope_unit": "µm"}, "slope_unit must be a word"),
        ({"slope_unit": " pixel"}, "slope_unit must be a word"),
        ({"command_unit": "x" * 30}, "command_unit must be a word"),
        (
            {"slope_unit": "'/"},
            "slope_unit must be a word of at most 24 ASCII signs without a quote",
        ),
        ({"command_unit": ""}, "command_unit must not be empty"),
        ({"measurement_unit": "m"}, "measurement_unit must be nm for lengths; got 'm'"),
        ({"measurement_unit": 3}, "measurement_unit must be a word"),
        ({"name": None}, "name must be a text"),
        ({"controller_name": 3}, "controller_name must be a text"),
        ({"metadata": [1]}, "metadata must be a mapping; got list"),
        ({"metadata": {1: 2}}, "keys of metadata must be words; got 1"),
        ({"metadata": {"": 2}}, "keys of metadata must be words; got ''"),
        ({"metadata": {"a": [1]}}, "metadata must hold texts, numbers and truth values; got list"),
        ({"metadata": {"a": float("inf")}}, "metadata must be finite; got inf for 'a'"),
        ({"integrator_gains": [0.4]}, "integrator_gains must have shape"),
        ({"controller": 3}, "controller must be a Controller; got int"),
        (
            {"frame_rate_hz": 801.0, "mirror": None},
            "controller must run at 801 Hz; got one for 800 Hz",
        ),
    ],
)
def test_what_does_not_fit_is_refused(changes, text):
    with pytest.raises(lbt.errors.ProblemError, match=text):
        full(**changes)


def test_a_controller_of_other_sizes_is_refused():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    one = lbt.integrator(path, gain=0.4).controller
    with pytest.raises(
        lbt.errors.DimensionError, match="must map 2 measurements to 2 commands; got 1 to 1"
    ):
        full(controller=one)


def test_telemetry_cannot_be_changed():
    series = np.ones((6, 2))
    metadata = {"a": np.int64(3)}
    seen = full(commands=series, metadata=metadata)
    series[0, 0] = 5
    metadata["b"] = 1
    assert seen.commands[0, 0] == 1
    assert dict(seen.metadata) == {"a": 3}
    assert type(seen.metadata["a"]) is int
    with pytest.raises(ValueError):
        seen.commands[0, 0] = 2
    with pytest.raises(TypeError):
        seen.metadata["a"] = 4
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.seed = 3


# ---------------------------------------------------------------- files that are no good
@pytest.mark.parametrize("ending", ENDINGS)
def test_truncated_files_are_refused(tmp_path, ending):
    path = lbt.files.save_telemetry(tmp_path / f"t.{ending}", full())
    content = path.read_bytes()
    for length in np.linspace(0, len(content) - 40, 30).astype(int):
        path.write_bytes(content[:length])
        with pytest.raises(lbt.errors.TelemetryError) as caught:
            lbt.files.load_telemetry(path)
        assert "\n" not in str(caught.value)
        assert caught.value.path == path


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    ending=st.sampled_from(ENDINGS), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7)
)
def test_a_flipped_bit_is_found_or_harmless(tmp_path, ending, place, bit):
    seen = full()
    path = lbt.files.save_telemetry(tmp_path / f"t.{ending}", seen)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    path.write_bytes(bytes(content))
    try:
        back = lbt.files.load_telemetry(path)
    except lbt.errors.TelemetryError:
        return
    assert same(seen, back)


def test_foreign_files_are_refused(tmp_path):
    picture = tmp_path / "image.fits"
    fits.PrimaryHDU(np.ones((4, 4))).writeto(picture)
    other = tmp_path / "other.npz"
    np.savez(other, a=np.ones(3))
    gain = lbt.save_gain(tmp_path / "gain.fits", lbt.kalman(lbt_axis_plant()))
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, META=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for path in (picture, other, gain, pickled):
        with pytest.raises(lbt.errors.TelemetryError, match=f"{path.name} is "):
            lbt.files.load_telemetry(path)
    with pytest.raises(lbt.errors.GainFileError, match="is not a gain file"):
        lbt.load_gain(lbt.files.save_telemetry(tmp_path / "t.fits", full()))


def edited(tmp_path, change, *, resign=True):
    """Write a file whose arrays and metadata somebody changed."""
    arrays, meta = native_layout.pack(full(), "float64")
    arrays = {name: np.array(array) for name, array in arrays.items()}
    meta["digest"] = archive.digest(arrays, meta)
    change(arrays, meta)
    if resign:
        meta["digest"] = archive.digest(arrays, meta)
    path = tmp_path / "t.npz"
    path.write_bytes(archive.npz_bytes(arrays, json.dumps(meta)))
    return path


@pytest.mark.parametrize(
    ("change", "resign", "text"),
    [
        (lambda a, m: m.update(schema="recipes"), True, "is not a telemetry file of lbt_synth"),
        (lambda a, m: m.update(schema_version=9), True, "layout version 9; this lbt_synth reads 1"),
        (lambda a, m: a["COMMANDS"].__setitem__(0, 3.0), False, "does not match its digest"),
        (lambda a, m: m.update(seed=8), False, "does not match its digest"),
        (lambda a, m: a.pop("COMMANDS"), True, "inconsistent: COMMANDS is missing"),
        (lambda a, m: a.pop("CTRL_B"), True, "inconsistent: CTRL_B is missing"),
        (lambda a, m: m.pop("seed"), True, "inconsistent: seed is missing"),
        (lambda a, m: a.update(EXTRA=np.ones(2)), True, "arrays that no telemetry has: EXTRA"),
        (lambda a, m: a.update(MEASURE=np.ones((2, 2))), True, "measurements must have 6 rows"),
        (lambda a, m: a["SLOPES"].fill(np.nan), True, "slopes must be finite"),
        (lambda a, m: m.update(frame_rate_hz="fast"), True, "frame_rate_hz must be a number"),
        (lambda a, m: m.update(metadata=3), True, "inconsistent"),
        (lambda a, m: m.update(metadata={"a": [1]}), True, "metadata must hold"),
    ],
)
def test_edited_files_are_refused(tmp_path, change, resign, text):
    with pytest.raises(lbt.errors.TelemetryError, match=text):
        lbt.files.load_telemetry(edited(tmp_path, change, resign=resign))


def test_names_and_formats(tmp_path):
    seen = full()
    for name, kind, text in (
        ("t.txt", None, "telemetry must end in .fits, .npz or .aot.fits; got 't.txt'"),
        ("t.fits", "npz", "does not fit the format 'npz'"),
        ("t.npz", "fits", "does not fit the format 'fits'"),
        ("t.aot.fits", "fits", "does not fit the format 'fits'"),
        ("t.fits", "hdf5", "must be one of fits, npz, aot; got 'hdf5'"),
    ):
        with pytest.raises(lbt.errors.OutputError, match=text):
            lbt.files.save_telemetry(tmp_path / name, seen, format=kind)
    with pytest.raises(lbt.errors.OutputError, match="holds a Telemetry; got int"):
        lbt.files.save_telemetry(tmp_path / "t.fits", 3)
    with pytest.raises(lbt.errors.OutputError, match="No such file or directory"):
        lbt.files.save_telemetry(tmp_path / "nowhere" / "t.fits", seen)
    with pytest.raises(lbt.errors.TelemetryError, match="must end in"):
        lbt.files.load_telemetry(tmp_path / "t.txt")
    (tmp_path / "folder.fits").mkdir()
    with pytest.raises(lbt.errors.TelemetryError, match="cannot read"):
        lbt.files.load_telemetry(tmp_path / "folder.fits")
    with pytest.raises(lbt.errors.TelemetryError, match="null"):
        lbt.files.load_telemetry("x\0y.npz")


def test_nothing_half_written_stays(tmp_path, monkeypatch):
    path = lbt.files.save_telemetry(tmp_path / "t.fits", full())
    before = path.read_bytes()

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(lbt.errors.OutputError, match="No space left on device"):
        lbt.files.save_telemetry(path, full(random=1))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["t.fits"]
