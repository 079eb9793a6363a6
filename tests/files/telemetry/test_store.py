"""Telemetry files, and telemetry of simulations."""

import json

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.telemetry import ENDINGS, SHELL, full, same, telemetries

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, OutputError, ProblemError, TelemetryError
from lbt_synth.files import Telemetry, load_telemetry, save_telemetry, telemetry_from_simulation
from lbt_synth.files.telemetry import store
from lbt_synth.files.telemetry.aot import lost_fields
from lbt_synth.files.telemetry.telemetry import LAYERS
from lbt_synth.models import ARModel, SinusoidalVibration
from lbt_synth.storage import array_file as archive


@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip_keeps_every_bit(tmp_path, ending):
    least = Telemetry(frame_rate_hz=1.0, commands=[[1.0]], measurements=[[2.0]])
    for seen in (full(), full(with_slopes=False), least):
        assert same(seen, load_telemetry(save_telemetry(tmp_path / f"t.{ending}", seen)))


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seen=telemetries(), ending=st.sampled_from(ENDINGS))
def test_any_telemetry_comes_back(tmp_path, seen, ending):
    assert same(seen, load_telemetry(save_telemetry(tmp_path / f"t.{ending}", seen)))


@pytest.mark.parametrize("ending", ENDINGS)
def test_float32_rounds_series_and_nothing_else(tmp_path, ending):
    seen = full(frames=2000)
    path = save_telemetry(tmp_path / f"t.{ending}", seen, precision="float32")
    back = load_telemetry(path)
    series = [
        layer.field for layer in LAYERS.values() if layer.is_series and layer.field != "times_s"
    ]
    assert same(seen, back, but=series)
    for name in series:
        assert np.array_equal(getattr(back, name), getattr(seen, name).astype(np.float32))
    exact = save_telemetry(tmp_path / f"exact.{ending}", seen)
    assert path.stat().st_size < 0.75 * exact.stat().st_size


def test_float32_refuses_what_it_cannot_hold(tmp_path):
    seen = Telemetry(frame_rate_hz=1.0, commands=[[1e39]], measurements=[[2.0]])
    with pytest.raises(ProblemError, match="commands has values beyond the range of float32"):
        save_telemetry(tmp_path / "t.fits", seen, precision="float32")
    with pytest.raises(ProblemError, match="precision must be one of float64, float32"):
        save_telemetry(tmp_path / "t.fits", seen, precision="half")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("delay", "ending"), [(1.0, "npz"), (2.25, "fits"), (3.5, "npz")])
def test_the_loop_equations_hold_in_the_file_alone(tmp_path, delay, ending):
    """What the file says of timing, checked on a simulation without noise."""
    rng = np.random.default_rng(3)
    path = lbt.LoopHardware(
        frame_rate_hz=500.0,
        delay_frames=delay,
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=[[1.0, 0.2], [-0.1, 0.8]],
    )
    slow = ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=500)
    truth = lbt.Truth(turbulence=slow, noise_nm=0.0, sensor_gain=0.6)
    design = lbt.integrator(path, gain=0.2)
    run = lbt.simulate(design.controller, truth, hardware=path, frames=60, cases=2, seed=5)
    save_telemetry(
        tmp_path / f"t.{ending}",
        telemetry_from_simulation(run, path, case=1, sensor_gain=0.6, design=design),
    )
    seen = load_telemetry(tmp_path / f"t.{ending}")
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
def test_the_equation_of_a_moving_mirror_holds_in_the_file_alone(tmp_path, kind):
    """phi_cor(k) = N (c0 u(k) + c1 u(k-1) + ...), as the file says, with what it holds."""
    path = lbt.LoopHardware(
        frame_rate_hz=800.0,
        delay_frames=2.25,
        influence_matrix=[[1.0, 0.2], [-0.1, 0.8]],
        mirror=SHELL,
    )
    slow = ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=slow, noise_nm=3.0)
    design = lbt.integrator(path, gain=0.1)
    run = lbt.simulate(design.controller, truth, hardware=path, frames=120, seed=5)
    written = telemetry_from_simulation(run, path, design=design)
    name = "t.aot.fits" if kind == "aot" else f"t.{kind}"
    seen = load_telemetry(save_telemetry(tmp_path / name, written))
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


def edited(tmp_path, change, *, resign=True):
    """Write a file whose arrays and metadata somebody changed."""
    arrays, meta = store.pack(full(), "float64")
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
        (
            lambda a, m: m.update(schema_version=9),
            True,
            "layout version 9, of lbt_synth .*; this version reads 1. Try another copy",
        ),
        (lambda a, m: a["COMMANDS"].__setitem__(0, 3.0), False, "does not match its digest"),
        (lambda a, m: m.update(seed=8), False, "does not match its digest"),
        (lambda a, m: a.pop("COMMANDS"), True, "inconsistent: COMMANDS is missing"),
        (lambda a, m: a.pop("CTRL_B"), True, "inconsistent: CTRL_B is missing"),
        (lambda a, m: m.pop("seed"), True, "inconsistent: seed is missing"),
        (lambda a, m: a.update(EXTRA=np.ones(2)), True, "arrays that no telemetry has: EXTRA"),
        (lambda a, m: a.update(MEASURE=np.ones((2, 2))), True, "measurements must have 6 frames"),
        (lambda a, m: a["SLOPES"].fill(np.nan), True, "slopes must be finite"),
        (lambda a, m: m.update(frame_rate_hz="fast"), True, "frame_rate_hz must be a number"),
        (lambda a, m: m.update(metadata=3), True, "inconsistent"),
        (lambda a, m: m.update(metadata={"a": [1]}), True, "metadata must hold"),
    ],
)
def test_edited_files_are_refused(tmp_path, change, resign, text):
    with pytest.raises(TelemetryError, match=text):
        load_telemetry(edited(tmp_path, change, resign=resign))


def test_names_and_formats(tmp_path):
    seen = full()
    for name, kind, text in (
        ("t.fits", "npz", "does not fit the format 'npz'"),
        ("t.npz", "fits", "does not fit the format 'fits'"),
        ("t.aot.fits", "fits", "does not fit the format 'fits'"),
        ("t.fits", "hdf5", "must be one of fits, npz, aot; got 'hdf5'"),
    ):
        with pytest.raises(OutputError, match=text):
            save_telemetry(tmp_path / name, seen, format=kind)
    with pytest.raises(OutputError, match="holds a Telemetry; got int"):
        save_telemetry(tmp_path / "t.fits", 3)


def test_the_fits_file_explains_itself(tmp_path):
    """Read with astropy alone: names, units, axes, timing."""
    seen = full()
    with fits.open(save_telemetry(tmp_path / "t.fits", seen)) as units:
        header = units[0].header
        assert units[0].data is None
        assert header["LBTTELEM"] == 1
        assert (header["RATE_HZ"], header["DELAY"], header["SENSGAIN"]) == (800, 2.25, 0.358)
        assert (header["DIAMETER"], header["STREHL"], header["WAVELEN"]) == (8.22, 0.83, 2.2)
        assert header["TIMING"] == seen.convention
        assert "with the mirror taps c" in seen.convention
        assert np.array_equal(units["MIRROR_TAPS"].data, seen.hardware.mirror_taps)
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
    with np.load(lbt.files.save_telemetry(tmp_path / "t.npz", seen)) as arrays:
        assert np.array_equal(arrays["MIRROR_TAPS"], seen.hardware.mirror_taps)


def test_the_camera_gives_telescope_and_strehl_ratio():
    path = lbt.LoopHardware(frame_rate_hz=800)
    design = lbt.integrator(path, gain=0.5)
    shake = SinusoidalVibration(frequency_hz=20, rms_nm=200)
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


def test_what_is_no_simulation_is_refused(axis_plant):
    path = axis_plant.hardware
    control = lbt.kalman(axis_plant).controller
    run = lbt.simulate(control, lbt.Truth(turbulence=None), hardware=path, frames=5)
    other, two = (lbt.LoopHardware(frame_rate_hz=f, modes=m) for f, m in ((500, 1), (800, 2)))
    for parts, options, words in (
        ((run, path), {"case": 1}, "case must be below the number of cases, 1; got 1"),
        ((run, other), {}, "must be that of the simulation, at 800 Hz"),
        ((3, path), {}, "expected a Simulation; got int"),
        ((run, 3), {}, "expected a LoopHardware; got int"),
        ((run, path), {"design": control}, "expected a Design; got Controller"),
    ):
        with pytest.raises(ProblemError, match=words):
            lbt.files.telemetry_from_simulation(*parts, **options)
    words = "interaction_matrix must have 1 measurement to match measurements"
    with pytest.raises(DimensionError, match=words):
        lbt.files.telemetry_from_simulation(run, two)
