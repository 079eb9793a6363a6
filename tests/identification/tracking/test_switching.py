"""Filters exchanged in a running loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant
from support.tracking import AIR, axis, disturbed, run, sensed

import lbt_synth as lbt
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise
from lbt_synth.models.plant.tip_tilt import with_vibrations

SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=300
)


class Exchanged:
    """A filter that is replaced by another one before a frame."""

    def __init__(self, old, new, frame, **options):
        self.old, self.new, self.frame = old, new, frame
        self.running = lbt.identification.SwitchedController(old, **options)

    def reset(self):
        self.k = 0
        self.running.reset()

    def step(self, y):
        if self.k == self.frame:
            self.report = self.running.switch(self.new)
        self.k += 1
        return self.running.step(y)


class Parallel(Exchanged):
    """The same by an estimator of the new filter that runs from the first frame on."""

    def reset(self):
        self.k = 0
        self.before, self.shadow = self.old.controller.start(), self.new.estimator.start()
        self.u = np.zeros(self.old.hardware.n_commands)

    def step(self, y):
        estimate = self.shadow.step(np.concatenate([y, self.u]))
        command = self.before.step(y)
        projector = self.new.hardware.projector
        self.u = projector @ estimate if self.k >= self.frame else command
        self.k += 1
        return self.u


class Cold(Exchanged):
    """The new controller begins with a zero state."""

    def reset(self):
        self.k = 0
        self.running = self.old.controller.start()

    def step(self, y):
        if self.k == self.frame:
            self.running = self.new.controller.start()
        self.k += 1
        return self.running.step(y)


PLANTS = {
    "delay 1": axis(20, delay_frames=1),
    "delay 2": axis(20),
    "delay 2.4": axis(20, delay_frames=2.4),
    "delay 3": axis(20, delay_frames=3),
    "a slow mirror": axis(20, mirror=SHELL),
    "two axes": sensed(None),
}


@pytest.mark.parametrize("name", PLANTS)
def test_alone_it_is_the_controller_of_the_design(name):
    plant = PLANTS[name]
    design = lbt.kalman(plant)
    n, q = plant.hardware.modes, plant.hardware.n_measurements
    rng = np.random.default_rng(1)
    series = 100 * rng.standard_normal((1, 300, n)), rng.standard_normal((1, 300, q))
    one = run(lbt.identification.SwitchedController(design), plant, series)
    other = run(design.controller.start(), plant, series)
    assert np.allclose(one, other, rtol=0, atol=1e-11 * np.abs(other).max())


def test_the_same_filter_changes_nothing_at_all():
    plant = axis(20)
    series = disturbed(plant, frames=1500)
    design, again = lbt.kalman(plant), lbt.kalman(axis(20))
    kept = run(lbt.identification.SwitchedController(design), plant, series)
    for memory_s in (0.1, 8):
        change = Exchanged(design, again, 1000, memory_s=memory_s)
        assert np.array_equal(run(change, plant, series), kept)
        assert change.report == lbt.identification.SwitchReport(copied=True, frames=0, left=0.0)


def test_the_same_filter_run_over_the_record_changes_no_command():
    """Without the shortcut for equal matrices: a sensor matrix that is equal but for rounding."""
    plant = axis(20)
    series = disturbed(plant, frames=4000)
    design = lbt.kalman(plant)
    almost = lbt.kalman(axis(20, sensor_matrix=[[1 + 2**-52]]))
    kept = run(lbt.identification.SwitchedController(design), plant, series)
    # all is recorded; and the record is shorter than the run, but longer than the filter's memory
    for memory_s in (8, 3):
        change = Exchanged(design, almost, 3500, memory_s=memory_s)
        changed = run(change, plant, series)
        assert not change.report.copied
        assert change.report.left < 1e-12
        assert np.max(np.abs(changed - kept)) < 1e-10 * np.max(np.abs(kept))


@pytest.mark.parametrize("name", PLANTS)
def test_the_new_filter_is_as_if_it_had_always_run(name):
    """Against its estimator in parallel; from zero it would be far off."""
    plant = PLANTS[name]
    hw = plant.hardware
    moved = [v.at_frequency(v.frequency_hz + 2) for v in plant.vibrations]
    slower = lbt.Vibration(frequency_hz=33, damping=0.02, rms_nm=50, direction=moved[0].direction)
    old, new = lbt.kalman(plant), lbt.kalman(with_vibrations(plant, [*moved, slower]))
    truth = lbt.Truth(turbulence=AIR, vibrations=(replace(moved[0], rms_nm=250.0),), noise_nm=15.5)
    rng = np.random.default_rng(3)
    size = {"frames": 1200, "cases": 1, "rng": rng}
    series = draw_disturbance(truth, hw, **size), draw_noise(truth, hw, **size)
    kinds = (Parallel, Exchanged, Cold)
    shadow, replayed, cold = (run(kind(old, new, 1000), plant, series) for kind in kinds)
    scale = np.max(np.abs(shadow))
    assert np.max(np.abs(replayed - shadow)) < 1e-10 * scale
    assert np.max(np.abs(cold - shadow)[1000:]) > 0.05 * scale


def test_a_record_that_is_too_short_says_what_is_left():
    plant = axis(20)
    series = disturbed(plant, frames=2000)
    old, new = lbt.kalman(plant), lbt.kalman(axis(22))
    shadow = run(Parallel(old, new, 1800), plant, series)
    errors, left = [], []
    for memory_s in (0.05, 0.5, 1.0):
        change = Exchanged(old, new, 1800, memory_s=memory_s)
        replayed = run(change, plant, series)
        errors.append(np.max(np.abs(replayed - shadow)) / np.max(np.abs(shadow)))
        left.append(change.report.left)
        radius = np.max(np.abs(new.poles))
        assert change.report.frames == round(800 * memory_s)
        assert change.report.left == pytest.approx(radius**change.report.frames)
    assert errors[0] > errors[1] > errors[2]
    assert all(error < 10 * rest for error, rest in zip(errors, left, strict=True))


def test_a_cold_exchange_bumps_the_residual_and_this_one_does_not():
    plant = axis(20)
    series = disturbed(plant, frames=2000)
    old, new = lbt.kalman(plant), lbt.kalman(axis(20.5))
    after = slice(1800, 1880)
    kinds = (Parallel, Exchanged, Cold)
    shadow, replayed, cold = (
        np.sqrt(np.mean(run(kind(old, new, 1800), plant, series)[after, 0] ** 2)) for kind in kinds
    )
    assert replayed == pytest.approx(shadow, rel=1e-9)
    assert cold > 3 * shadow


def test_measurements_that_are_not_numbers_hold_the_command():
    plant = axis(20)
    running = lbt.identification.SwitchedController(lbt.kalman(plant))
    total, noise = disturbed(plant, frames=1200)
    clean = run(running, plant, (total, noise))
    broken = noise.copy()
    broken[0, [500, 501, 700], 0] = [np.nan, np.inf, -np.inf]
    out = run(running, plant, (total, broken))
    assert running.spoilt == 3
    assert out[500, 1] == out[501, 1] == out[499, 1]
    assert out[700, 1] == out[699, 1]
    assert np.array_equal(out[:500], clean[:500])
    # the estimate went on: after a second nothing is to be seen of it
    assert np.max(np.abs(out - clean)[1100:, :2]) < 0.5
    assert running.spoilt_fraction() == pytest.approx(3 / 1200)
    assert running.spoilt_fraction(100) == 0
    measured, corrections = running.window()
    assert np.isfinite(measured).all()
    open_loop = measured + corrections  # = phi_tot(k-1) + noise(k)
    expected = np.concatenate([[0], total[0, :-1, 0]]) + noise[0, :, 0]
    good = np.isfinite(broken[0, :, 0])
    assert np.allclose(open_loop[good, 0], expected[good], rtol=0, atol=1e-9 * np.abs(total).max())
    running.reset()
    assert (running.spoilt, running.frames) == (0, 0)
    assert running.window()[0].shape == (0, 1)
    assert running.spoilt_fraction() == 0


def test_only_filters_of_the_same_loop_are_exchanged():
    plant = axis(20)
    design = lbt.kalman(plant)
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    for wrong in (lbt.kalman(walk), lbt.integrator(plant.hardware, gain=0.3), lbt.lqg(plant), None):
        with pytest.raises(lbt.errors.ProblemError, match="only filters of a TipTiltPlant"):
            lbt.identification.SwitchedController(wrong)
    running = lbt.identification.SwitchedController(design)
    for other in (
        axis(20, delay_frames=3),
        axis(20, mirror=SHELL),
        axis(20, influence_matrix=[[2.0]]),
        axis(20, sensor_matrix=[[1.0], [1.0]]),
        lbt_axis_plant(modes=2),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="must be for the running loop"):
            running.switch(lbt.kalman(other))
    assert running.design is design
    with pytest.raises(lbt.errors.DimensionError, match=r"y must have shape \(1,\)"):
        running.step([1.0, 2.0])
    for memory_s in (0, 1e-4, np.inf):
        with pytest.raises(lbt.errors.ProblemError, match="memory_s"):
            lbt.identification.SwitchedController(design, memory_s=memory_s)


def test_a_filter_of_another_sensor_gain_keeps_its_own():
    """The record is of measurements and corrections, so each filter takes them as it must."""
    plant, weak = axis(20), axis(20, sensor_gain=0.6)
    old, new = lbt.kalman(plant), lbt.kalman(weak)
    series = disturbed(plant, frames=1500)
    one, other = (
        run(kind(old, new, 1200), plant, series, gain=0.6) for kind in (Parallel, Exchanged)
    )
    assert np.allclose(one, other, rtol=0, atol=1e-10 * np.abs(one).max())
