"""The end-to-end simulation on SPECULA's optics: a small telescope, seconds a test."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.json_cases import make_case, run_case
from lbt_synth.interop.specula.optics import Optics, make_modes

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.filterwarnings("ignore::DeprecationWarning:specula"),
]
PATH = lbt.LoopHardware(frame_rate_hz=800)
BRIGHT = lbt.interop.EndToEndSystem(
    hardware=PATH,
    diameter_m=1.5,
    obstruction=0.2,
    seeing_arcsec=0.02,
    outer_scale_m=10,
    wind_speed_m_s=5,
    sensing_wavelength_um=0.75,
    modulation_lambda_over_d=4,
    subapertures_across=8,
    photons=1e5,
    read_noise_electrons=0,
    modes=20,
    actuators_across=7,
    pixels=24,
)
SETUP = lbt.interop.EndToEndSetup(
    system=BRIGHT, frames=400, settle_frames=200, gain=0.5, leak=1.0, leak_from_mode=2
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def calibration(cache):
    return lbt.interop.calibrate(BRIGHT, cache=cache)


def test_the_modes_are_orthonormal_and_the_first_are_tip_and_tilt(calibration):
    modes = calibration.modes
    gram = modes.shapes @ modes.shapes.T / modes.shapes.shape[1]
    assert np.allclose(gram, np.eye(20), atol=1e-4)
    assert np.allclose(modes.shapes.mean(axis=1), 0, atol=1e-4)
    rows, columns = np.nonzero(modes.mask)
    plane = np.stack([np.ones(rows.size), rows, columns])
    for tilt in modes.shapes[:2]:
        left = tilt - plane.T @ np.linalg.lstsq(plane.T, tilt, rcond=None)[0]
        # as far as the mirror's actuators can make a plane
        assert np.std(left) < 0.05
    # a pupil of 1.5 m with an obstruction of 0.3 m
    lit = np.pi / 4 * 24**2 * (1 - 0.2**2)
    assert abs(modes.mask.sum() / lit - 1) < 0.05


def test_a_small_phase_is_reconstructed_whatever_its_mode(calibration):
    optics = Optics(BRIGHT, calibration.modes)
    rng = np.random.default_rng(0)
    phase = rng.normal(scale=2.0, size=20)
    slopes = optics.expose(-phase, [0, 0]) - calibration.reference
    found = calibration.reconstructor.matrix @ slopes
    assert np.allclose(found, phase, atol=0.05 * np.abs(phase).max())
    # the mirror subtracts, a vibration adds, and the phase is what is left
    optics.expose(np.r_[3.0, np.zeros(19)], [5.0, 7.0])
    assert np.allclose(calibration.modes.coefficients(optics.phase_nm())[:3], [2, 7, 0], atol=1e-3)
    strehl, image = optics.image()
    rms = np.std(optics.phase_nm())
    assert strehl == pytest.approx(np.exp(-((2 * np.pi * rms / 2200) ** 2)), rel=1e-4)
    assert image.sum() == pytest.approx(1, rel=1e-5)


def test_a_calibration_is_kept_by_its_content(cache, calibration):
    again = lbt.interop.calibrate(BRIGHT, cache=cache)
    assert again.cached
    assert again.key == calibration.key
    assert np.array_equal(again.reconstructor.matrix, calibration.reconstructor.matrix)
    assert np.array_equal(again.modes.shapes, calibration.modes.shapes)
    # the flux plays no part, the modulation does
    assert lbt.interop.calibrate(replace(BRIGHT, photons=10.0), cache=cache).cached
    other = lbt.interop.calibrate(replace(BRIGHT, modulation_lambda_over_d=3.0), cache=cache)
    assert not other.cached
    assert other.key != calibration.key


def test_a_damaged_calibration_is_measured_anew(tmp_path, calibration):
    first = lbt.interop.calibrate(BRIGHT, cache=tmp_path)
    (file,) = tmp_path.glob("calibration-*.npz")
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:-2000] + b"x" * 2000):
        file.write_bytes(damage)
        found = lbt.interop.calibrate(BRIGHT, cache=tmp_path)
        assert not found.cached
        assert np.array_equal(found.reconstructor.matrix, first.reconstructor.matrix)
        assert lbt.interop.calibrate(BRIGHT, cache=tmp_path).cached


def test_too_many_modes_for_the_mirror():
    with pytest.raises(ProblemError, match="40 modes need a mirror with more actuators"):
        make_modes(replace(BRIGHT, modes=40))


# a filter for 40 Hz leaves much of a line at 44 Hz
SHAKE = lbt.models.SinusoidalVibration(frequency_hz=44, rms_nm=60.0, direction=(0.8, 0.6))
PLANT = lbt.tip_tilt_plant(
    frame_rate_hz=800,
    turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=0.5, frame_rate_hz=800),
    noise_nm=0.3,
    vibrations=[
        lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=20, direction=d)
        for d in ((1, 0), (0, 1))
    ],
)


@pytest.mark.parametrize(("method", "delay"), [("integrator", 2.5), ("kalman", 2.0)])
def test_in_the_linear_range_it_is_the_modal_loop(cache, method, delay):
    """A vibration of 60 nm and a bright star: residual and gain as the exact analysis says."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay)
    setup = replace(
        SETUP, system=replace(BRIGHT, hardware=path), vibrations=(SHAKE,), settle_frames=300
    )
    if method == "integrator":
        design = lbt.integrator(path, gain=0.3)
    else:
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800,
            delay_frames=delay,
            turbulence=PLANT.turbulence[0],
            noise_nm=0.3,
            vibrations=PLANT.vibrations,
        )
        design = lbt.kalman(plant)
    run = setup.run(design, cache=cache)
    assert run.tip_tilt_gain == pytest.approx(1.0, abs=0.05)
    truth = lbt.Truth(turbulence=None, vibrations=(SHAKE,), sensor_gain=run.tip_tilt_gain)
    loop = lbt.close_loop(path, design.controller, sensor_gain=run.tip_tilt_gain)
    expected = lbt.residual_budget(loop, truth).rms_nm
    found = np.hypot(*run.rms_nm[:2])
    # what the air and the photons add, in squares
    quiet = replace(setup, vibrations=()).run(design, cache=cache)
    still = np.hypot(*quiet.rms_nm[:2])
    assert np.sqrt(found**2 - still**2) == pytest.approx(expected, rel=0.04)
    assert still < expected


def test_the_same_seed_is_the_same_run_and_the_same_air(cache):
    setup = replace(SETUP, frames=20, settle_frames=200, vibrations=(SHAKE,))
    first, second = setup.run(None, cache=cache), setup.run(None, cache=cache)
    assert np.array_equal(first.residual_nm, second.residual_nm)
    assert np.array_equal(first.psf, second.psf)
    other = replace(setup, seed=1).run(None, cache=cache)
    assert not np.allclose(first.residual_nm, other.residual_nm)
    # with both mirrors at rest, the phase is that of air and vibration alone
    still = replace(setup, gain=0.0)
    a = still.run(None, tip_tilt_gain=0.0, cache=cache)
    b = setup.run(lbt.integrator(PATH, gain=0.3), cache=cache)
    taps = PATH.mirror_taps
    corrected = taps[1] * b.commands[:-1] + taps[0] * b.commands[1:]
    assert np.allclose(b.residual_nm[1:] + corrected, a.residual_nm[1:], atol=0.02)


def test_a_slow_mirror_of_the_hardware_is_that_of_the_optics(cache):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.4)
    run = replace(SETUP, system=replace(BRIGHT, hardware=path), frames=50, vibrations=(SHAKE,)).run(
        None, cache=cache
    )
    still = replace(
        SETUP, system=replace(BRIGHT, hardware=path), frames=50, vibrations=(SHAKE,), gain=0.0
    ).run(None, tip_tilt_gain=0.0, cache=cache)
    u = run.commands
    corrected = 0.6 * u[1:-1] + 0.4 * u[:-2]  # u(k-1) and u(k-2)
    assert np.allclose(run.residual_nm[2:] + corrected, still.residual_nm[2:], atol=0.02)


@pytest.mark.parametrize(
    ("returned", "match"),
    [(np.zeros(3), r"20 finite commands; got \(3,\)"), (np.full(20, np.nan), "not finite")],
)
def test_a_controller_that_returns_something_else(cache, returned, match):
    class Odd:
        def step(self, y):
            return returned

        def reset(self):
            pass

    with pytest.raises(ProblemError, match=match):
        lbt.interop.run_end_to_end(BRIGHT, Odd(), frames=2, settle_frames=200, cache=cache)


def test_a_case_is_its_run(cache):
    setup = replace(SETUP, frames=60, settle_frames=200, vibrations=(SHAKE,), seed=5)
    design = lbt.kalman(PLANT)
    direct = setup.run(design, cache=cache)
    case = json.loads(json.dumps(make_case(setup, design.controller, vibrations=(SHAKE,), seed=5)))
    result = run_case(case, cache=cache)
    assert result["strehl"] == direct.strehl
    assert result["tip_rms_nm"] == float(direct.rms_nm[0])
    shake = lbt.Vibration(frequency_hz=30, damping=0.05, rms_nm=10.0)
    case = json.loads(json.dumps(make_case(setup, None, vibrations=[shake], seed=5)))
    run = replace(setup, vibrations=(shake,)).run(None, cache=cache)
    assert run_case(case, cache=cache)["tip_rms_nm"] == float(run.rms_nm[0])


def small_config(folder):
    text = Path("examples/lbt.yaml").read_text()
    for old, new in (
        ("diameter_m: 8.22", "diameter_m: 1.5"),
        ("seeing_arcsec: 0.8 ", "seeing_arcsec: 0.1 "),
        ("subapertures_across: 30", "subapertures_across: 8"),
        ("photons: 50.0", "photons: 5000.0"),
        ("modes: 672", "modes: 20"),
        ("pixels: 60", "pixels: 24\n  actuators_across: 7"),
        ("frames: 1600", "frames: 40"),
        ("settle_frames: 400", "settle_frames: 200"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    file = folder / "small.yaml"
    file.write_text(text)
    return file


def test_the_command_writes_telemetry_that_is_the_run(tmp_path, cache, capsys):
    config, gain = small_config(tmp_path), tmp_path / "k.fits"
    lbt.save_gain(gain, lbt.kalman(lbt.load_config(config).plant))
    out = tmp_path / "run"
    arguments = [
        "end-to-end",
        str(config),
        str(gain),
        "-o",
        str(out),
        "--cache",
        str(cache),
        "--json",
    ]
    assert main(arguments) == 0
    data = json.loads(capsys.readouterr().out)
    assert sorted(p.name for p in out.iterdir()) == ["run.png", "summary.json", "telemetry.fits"]
    assert json.loads((out / "summary.json").read_text())["strehl"] == data["strehl"]
    telemetry = lbt.files.load_telemetry(out / "telemetry.fits")
    assert telemetry.strehl == data["strehl"]
    assert telemetry.commands.shape == (40, 20)
    assert np.std(telemetry.residual_nm[:, 0]) <= data["tip_rms_nm"] * (1 + 1e-12)
    # y(k+1) is the gain times the residual of frame k, plus noise
    y, phase = telemetry.measurements[1:, :2], telemetry.residual_nm[:-1, :2]
    assert np.sum(y * phase) / np.sum(phase**2) == pytest.approx(telemetry.sensor_gain)
    assert main(arguments[:-1]) == 0
    assert "Strehl ratio at 2.2 um" in capsys.readouterr().out


def test_a_table_that_was_killed_goes_on(tmp_path, cache):
    config, out = small_config(tmp_path), tmp_path / "table"
    arguments = [
        sys.executable,
        "-m",
        "lbt_synth.cli.main",
        "end-to-end-table",
        str(config),
        "-o",
        str(out),
        "--cache",
        str(cache),
        "--seeds",
        "1",
        "--tables",
        "II",
        "--jobs",
        "2",
        "--json",
    ]
    first = subprocess.Popen(arguments, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 120
    while len(list(out.glob("cases/*.json"))) < 2:
        assert first.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < end
        time.sleep(0.02)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    kept = {p.name: p.read_text() for p in out.glob("cases/*.json")}
    assert 2 <= len(kept) < 6
    second = subprocess.run(arguments, capture_output=True, text=True, check=True, timeout=300)
    data = json.loads(second.stdout)
    assert data["runs"] == 6
    assert len(list(out.glob("cases/*.json"))) == 6
    for name, text in kept.items():
        assert (out / "cases" / name).read_text() == text
    assert {(e["row"], e["method"]) for e in data["entries"]} == {
        (row, method)
        for row in ("no vibration", "vibration")
        for method in ("classical", "kalman", "hinf")
    }
    lines = (out / "table_ii.csv").read_text().splitlines()
    assert len(lines) == 7


def test_phase_screens_are_kept_by_their_content_and_drawn_anew_if_damaged(tmp_path, calibration):
    setup = replace(SETUP, frames=20, settle_frames=200)
    known = {"cache": tmp_path, "calibration": calibration}
    first = setup.run(None, **known)
    (file,) = tmp_path.glob("screens/*/*.fits")
    whole = file.read_bytes()
    for damage in (whole[:1000], b"", whole[: len(whole) // 2]):
        file.write_bytes(damage)
        assert np.array_equal(setup.run(None, **known).residual_nm, first.residual_nm)
        assert file.read_bytes() == whole
    # 1.5 and 1.5001 m have the same pixel to three decimals, which is how SPECULA names a screen
    other = replace(BRIGHT, diameter_m=1.5001)
    lbt.interop.run_end_to_end(other, setup.controller(None), frames=2, settle_frames=200, **known)
    assert len(list(tmp_path.glob("screens/*/*.fits"))) == 2


def test_a_cache_that_takes_no_screens(tmp_path, calibration):
    (tmp_path / "screens").write_text("not a directory")
    with pytest.raises(lbt.errors.OutputError, match="phase screen"):
        replace(SETUP, frames=2).run(None, cache=tmp_path, calibration=calibration)
