"""Telemetry files, and telemetry of simulations."""

import json

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.refusals import refused, require_refusals
from support.telemetry import ENDINGS, SHELL, full, same, telemetries

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, OutputError, ProblemError, TelemetryError
from lbt_synth.files import load_telemetry, save_telemetry, telemetry_from_simulation
from lbt_synth.files.telemetry import store
from lbt_synth.files.telemetry.aot import lost_fields
from lbt_synth.files.telemetry.telemetry import LAYERS
from lbt_synth.storage import array_file as archive


@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip_keeps_every_bit(tmp_path, ending):
    gaps = np.where(np.eye(6, 3) > 0, np.nan, 1.0)
    seen, gappy = (
        load_telemetry(save_telemetry(tmp_path / f"t.{ending}", full(**changes)))
        for changes in ({}, {"measurements": gaps})
    )
    assert same(full(), seen)
    assert np.array_equal(gappy.measurements, gaps, equal_nan=True)


@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seen=telemetries(), ending=st.sampled_from(ENDINGS))
def test_any_telemetry_comes_back(tmp_path, seen, ending):
    assert same(seen, load_telemetry(save_telemetry(tmp_path / f"t.{ending}", seen)))


@pytest.mark.parametrize(
    ("delay", "mirror", "name"),
    [
        *((1.0, None, "t.npz"), (2.25, None, "t.fits"), (3.5, None, "t.npz")),
        *((2.25, SHELL, "t.fits"), (2.25, SHELL, "t.npz")),
        pytest.param(2.25, SHELL, "t.aot.fits", marks=pytest.mark.e2e),
    ],
)
def test_the_loop_equations_hold_in_the_file_alone(tmp_path, delay, mirror, name):
    """What the file says of timing is checked on a simulation without noise."""
    sensor = np.random.default_rng(3).standard_normal((3, 2))
    matrices = {"sensor_matrix": sensor, "influence_matrix": [[1.0, 0.2], [-0.1, 0.8]]}
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, mirror=mirror, **matrices)
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=slow, noise_nm=0.0, sensor_gain=0.6)
    design, size = lbt.integrator(path, gain=0.1), {"frames": 120, "cases": 2, "seed": 5}
    run = lbt.simulate(design.controller, truth, hardware=path, **size)
    written = telemetry_from_simulation(run, path, case=1, sensor_gain=0.6)
    seen = load_telemetry(save_telemetry(tmp_path / name, written))
    total, residual, u = run.total_nm[1], run.residual_nm[1], seen.commands
    if "aot" not in name:  # which has no place for them
        assert np.array_equal([seen.total_nm, seen.residual_nm], [total, residual])
        assert np.array_equal(run.commands[1], u)
    # y(k) = g S phi_res(k-1)
    expected = seen.sensor_gain * residual[:-1] @ seen.interaction_matrix.T
    assert np.allclose(seen.measurements[1:], expected, atol=1e-9)
    # phi_res(k) = phi_tot(k) - N ((1-f) u(k-j) + f u(k-j-1)), d = j + 1 + f, or with the taps
    j, f = int(delay - 1), delay % 1
    taps = [0.0] * j + [1 - f, f] if mirror is None else seen.mirror_taps
    corrected = sum(c * np.vstack([np.zeros((i, 2)), u[: len(u) - i]]) for i, c in enumerate(taps))
    error = total - corrected @ seen.influence_matrix.T - residual
    assert np.max(np.abs(error[len(taps) :])) < 1e-9
    if mirror is not None:
        assert len(taps) > 5
        assert "phi_cor(k) = N (c0 u(k) + c1 u(k-1)" in seen.convention
        assert "u(k-d+1)" not in seen.convention
    # u(k) from y up to k: an integrator is u(k) = u(k-1) + gain R y(k)
    inverse = np.linalg.pinv(seen.interaction_matrix @ seen.influence_matrix)
    assert np.allclose(np.diff(u, axis=0), 0.1 * (seen.measurements[1:] @ inverse.T), atol=1e-9)
    assert (seen.metadata["seed"], seen.delay_frames) == (5, delay)
    # the loop of the file is the loop that ran
    assert "mirror" not in lost_fields(seen)
    for field in ("sensor", "influence", "mirror_taps"):
        assert np.array_equal(getattr(seen.hardware, field), getattr(path, field))
    again = lbt.simulate(design, truth, hardware=seen.hardware, **size)
    assert np.allclose(again.residual_nm, run.residual_nm, rtol=0, atol=1e-9)


LAYOUT = "layout version 9, of lbt_synth .*; this version reads 2. Try another copy"
DIGEST = "does not match its digest"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda a, m: m.update(schema="recipes"), "is not a telemetry file of lbt_synth"),
        (lambda a, m: m.update(schema_version=9), LAYOUT),
        (lambda a, m: a["COMMANDS"].__setitem__(0, 3.0), DIGEST),
        (lambda a, m: m.update(sensor_gain=8), DIGEST),
        (lambda a, m: a.pop("MEASURE"), "inconsistent: MEASURE is missing"),
        (lambda a, m: m.pop("diameter_m"), "inconsistent: diameter_m is missing"),
        (lambda a, m: a.update(EXTRA=np.ones(2)), "arrays that no telemetry has: EXTRA"),
        (lambda a, m: a.update(MEASURE=np.ones((2, 3))), "measurements must have 6 frames"),
        (lambda a, m: a["TOTAL"].fill(np.nan), "total_nm must be finite"),
        (lambda a, m: m.update(frame_rate_hz="fast"), "frame_rate_hz must be a number"),
        (lambda a, m: m.update(metadata=3), "inconsistent"),
        (lambda a, m: m.update(metadata={"a": [1]}), "metadata must hold"),
        (lambda a, m: m.update(shown_unit="ell"), "shown_unit must be one of nm, um, mas, urad"),
    ],
)
def test_edited_files_are_refused(tmp_path, change, text):
    arrays, meta = store.pack(full())
    arrays = {name: np.array(array) for name, array in arrays.items()}
    meta["digest"] = archive.digest(arrays, meta)
    change(arrays, meta)
    if text != DIGEST:
        meta["digest"] = archive.digest(arrays, meta)
    path = tmp_path / "t.npz"
    path.write_bytes(archive.npz_bytes(arrays, json.dumps(meta)))
    refused(lambda: load_telemetry(path), TelemetryError, text)


def test_a_file_that_says_no_unit_is_seen_in_nm(tmp_path):
    arrays, meta = store.pack(full())
    assert meta.pop("shown_unit") == "mas"
    meta["digest"] = archive.digest(arrays, meta)
    (tmp_path / "t.npz").write_bytes(archive.npz_bytes(arrays, json.dumps(meta)))
    assert same(full(shown_unit="nm"), load_telemetry(tmp_path / "t.npz"))


def test_the_fits_file_explains_itself(tmp_path):
    seen = full()
    with fits.open(save_telemetry(tmp_path / "t.fits", seen)) as units:
        headers = {unit.name: unit.header for unit in units}
        facts = {"LBTTELEM": 2, "RATE_HZ": 800, "DELAY": 2.25, "SENSGAIN": 0.358}
        facts |= {"DIAMETER": 8.22, "WAVELEN": 2.2, "SHOWUNIT": "mas", "TIMING": seen.convention}
        assert {key: units[0].header[key] for key in facts} == facts
        axes = {"BUNIT": "pixel", "CTYPE2": "FRAME", "NAXIS2": 6, "CTYPE1": "MEASUREMENT"}
        assert axes.items() | {("NAXIS1", 3)} <= {*headers["MEASURE"].items()}
        assert headers["COMMANDS"]["BUNIT"] == "nm"
        assert units[0].data is None
        assert np.array_equal(units["COMMANDS"].data, seen.commands)
        assert (set(LAYERS) <= set(headers), units[-1].name) == (True, "META")
        meta = json.loads(units["META"].data.tobytes())
    assert "with the mirror taps c" in seen.convention
    assert meta["mirror_taps"] == seen.hardware.mirror_taps.tolist()


def test_the_camera_gives_telescope_and_strehl_ratio():
    shake = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=200)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11)
    path, three = (lbt.LoopHardware(frame_rate_hz=800, modes=modes) for modes in (2, 3))
    design, truth = lbt.integrator(path, gain=0.5), lbt.Truth(turbulence=None, vibrations=(shake,))
    ran = lbt.simulate(design, truth, hardware=path, frames=200, cases=2)
    seen = telemetry_from_simulation(ran, path, case=1, imaging=camera, metadata={"b": 1})
    assert dict(seen.metadata) == {"b": 1, "seed": 0, "strehl": ran.strehl(camera)[1]}
    assert (seen.diameter_m, seen.obstruction, seen.imaging_wavelength_um) == (8.22, 0.11, 2.2)
    calm, design = lbt.Truth(turbulence=None), lbt.integrator(three, gain=0.5)
    wide = lbt.simulate(design, calm, hardware=three, frames=5)
    assert "strehl" not in telemetry_from_simulation(wide, three, imaging=camera).metadata


def test_what_is_no_simulation_is_refused():
    path, other, two = (
        lbt.LoopHardware(frame_rate_hz=hz, modes=m) for hz, m in ((800, 1), (500, 1), (800, 2))
    )
    design = lbt.integrator(path, gain=0.5)
    run = lbt.simulate(design, lbt.Truth(turbulence=None), hardware=path, frames=5)

    def telemetry(run=run, path=path, **options):
        return lambda: telemetry_from_simulation(run, path, **options)

    rows = [
        (telemetry(case=1), ProblemError, "case must be below the number of cases, 1; got 1"),
        (telemetry(path=other), ProblemError, "must be that of the simulation, at 800 Hz"),
        (telemetry(3), ProblemError, "expected a Simulation; got int"),
        (telemetry(path=3), ProblemError, "expected a LoopHardware; got int"),
        (telemetry(path=two), DimensionError, "interaction_matrix must have 1 measurement to"),
        (lambda: save_telemetry("t.fits", 3), OutputError, "got int"),
    ]
    require_refusals(rows)
