"""A controller in closed loop with SPECULA's optics: a small telescope, seconds per test."""

from dataclasses import replace

import numpy as np
import pytest
from support.end_to_end import CONFIG
from support.small_telescope import BRIGHT, PATH, PLANT, SETUP, SHAKE, needs_specula

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


def test_a_run_needs_a_controller_with_steps(setup):
    with pytest.raises(ProblemError, match="step"):
        lbt.interop.run_end_to_end(setup.system, object())


@needs_specula
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


@needs_specula
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


@needs_specula
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


@needs_specula
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


@needs_specula
def test_phase_screens_are_kept_by_their_content_and_computed_again_if_damaged(
    tmp_path, calibration
):
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


@needs_specula
def test_a_cache_that_takes_no_screens(tmp_path, calibration):
    (tmp_path / "screens").write_text("not a directory")
    with pytest.raises(lbt.errors.OutputError, match="phase screen"):
        replace(SETUP, frames=2).run(None, cache=tmp_path, calibration=calibration)


def test_leaks_and_gains_of_the_mixed_controller(setup):
    control = setup.controller(None, tip_tilt_gain=0.7)
    first = control.step(np.ones(672))
    assert first[:2].tolist() == [0.7, 0.7]
    assert set(first[2:]) == {setup.gain}
    second = control.step(np.zeros(672))
    assert second[49] == setup.gain
    assert second[50] == pytest.approx(setup.leak * setup.gain)


def test_a_filter_of_another_loop_is_refused(setup):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    with pytest.raises(ProblemError, match=r"1000 Hz and 2 frames"):
        setup.controller(other)
    three = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=3), gain=0.5)
    with pytest.raises(ProblemError):
        setup.controller(three)


def test_a_filter_for_another_mirror_is_refused(setup):
    slow = lbt.load_config("examples/lbt_slow_mirror.yaml")
    with pytest.raises(ProblemError, match="another mirror"):
        setup.controller(lbt.lqg(slow.plant))
    with pytest.raises(ProblemError, match="another mirror"):
        slow.end_to_end.controller(lbt.kalman(lbt.load_config(CONFIG).plant))
    assert slow.end_to_end.controller(lbt.lqg(slow.plant)).n_modes == 672
