"""Figures of loops: curves of closed forms, margins where they are, loops that are unstable."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.figures import legend

import lbt_synth as lbt
from lbt_synth.report.figures.loops import closed_loops, frequency_grid, sigma_curves

FIGURES = lbt.report.figures
PATH = lbt.LoopHardware(frame_rate_hz=800)
HALF = {"half": lbt.integrator(PATH, gain=0.5)}  # a phase margin of 46.57 degrees at 64.3 Hz
NAME = "half: 46.6° at 64.3 Hz, +6.0 dB"


def draw(kind):
    """The figure of a view."""
    return partial(FIGURES.loop_figure, kind=kind)


def curve(axes, name):
    """Points of the first line of a name."""
    (line, *_) = [each for each in axes.get_lines() if each.get_label() == name]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def points(axes, name):
    """Places of all marks of a name."""
    found = [each for each in axes.get_lines() if each.get_label() == name]
    return [(float(each.get_xdata()[-1]), float(each.get_ydata()[-1])) for each in found]


def test_a_bode_plot_has_the_gain_and_the_phase_of_the_closed_form():
    gain, phase = draw("bode")(HALF).axes
    assert legend(gain) == [NAME, "gain margin"]
    assert legend(phase) == [NAME, "phase margin"]
    assert (gain.get_ylabel(), phase.get_ylabel()) == ("loop gain [dB]", "phase [deg]")
    f, decibels = curve(gain, NAME)
    assert decibels == pytest.approx(-20 * np.log10(4 * np.sin(np.pi * f / 800)), abs=1e-6)
    f, degrees = curve(phase, NAME)
    assert degrees == pytest.approx(-90 - 1.5 * 360 * f / 800, abs=1e-3)
    crossover = 800 / np.pi * np.arcsin(0.25)
    assert points(phase, "phase margin") == [
        pytest.approx((crossover, -90 - 540 * crossover / 800), abs=1e-3)
    ]
    assert points(gain, "gain margin") == [pytest.approx((800 / 6, -20 * np.log10(2)), abs=1e-6)]


def test_no_loop_of_a_nyquist_plot_enters_its_disks():
    (axes,) = draw("nyquist")(HALF).axes
    x, y = curve(axes, "loop")
    distance = np.abs(x + 1j * y + 1)
    across, up = curve(axes, "modulus margin")
    radius = np.hypot(across + 1, up)
    assert np.ptp(radius) < 1e-9
    assert radius[0] <= np.nanmin(distance) <= radius[0] * 1.001
    across, up = curve(axes, "disk margin")
    centre, radius = (across.max() + across.min()) / 2, np.ptp(across) / 2
    assert 0 <= np.nanmin(np.hypot(x - centre, y)) / radius - 1 < 1e-3
    margins = lbt.loop_margins(lbt.close_loop(PATH, HALF["half"].controller))
    assert -across.min() == pytest.approx(margins.disk_gain_high, rel=1e-3)
    assert axes.get_title(loc="left") == (
        f"half: disk {margins.disk:.2f}, modulus {margins.modulus:.2f}"
    )


def test_the_contours_of_a_nichols_plot_are_at_their_distance_from_minus_one():
    (axes,) = draw("nichols")(HALF).axes
    for modulus in (0.3, 0.5, 0.7):
        degrees, decibels = curve(axes, f"modulus {modulus:g}")
        response = 10 ** (decibels / 20) * np.exp(1j * np.radians(degrees))
        assert np.abs(1 + response) == pytest.approx(modulus)
    assert points(axes, "critical point") == [(-180, 0)]
    (margin,) = points(axes, "phase margin")
    assert margin == pytest.approx((-180 + 46.567, 0), abs=1e-3)


@pytest.mark.parametrize("kind", ["bode", "nyquist", "step"])
def test_axes_that_differ_are_drawn_each(kind):
    uneven = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=[[1.0, 0.0], [0.0, 0.5]])
    equal = lbt.integrator(uneven, gain=0.5)  # it inverts the sensor
    assert not any("axis" in name for name in legend(draw(kind)({"equal": equal}).axes[0]))
    sensor = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=50.0, frame_rate_hz=800),
        noise_nm=[5.0, 50.0],
    )
    names = legend(draw(kind)({"uneven": lbt.kalman(sensor)}).axes[0])
    assert sum("axis" in name for name in names) == 2


def test_an_unstable_loop_is_named_and_not_drawn():
    gain, _ = draw("bode")(HALF, sensor_gain=2.5).axes
    assert legend(gain)[0] == "half: unstable"
    (axes,) = draw("nyquist")(HALF, sensor_gain=2.5).axes
    assert axes.get_title(loc="left") == "half: unstable"
    assert "half: unstable" in legend(draw("nichols")(HALF, sensor_gain=2.5).axes[0])
    assert legend(draw("step")(HALF, sensor_gain=2.5).axes[0]) == ["half: unstable"]


def test_designs_without_a_loop_are_refused():
    walk = lbt.EstimationProblem(A=0.99, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    for kind in ("bode", "nyquist", "nichols"):
        with pytest.raises(lbt.errors.ProblemError, match="walk is a filter of a bare"):
            draw(kind)({"walk": lbt.kalman(walk)})
        with pytest.raises(lbt.errors.ProblemError, match="at least one design"):
            draw(kind)({})


def test_a_sigma_plot_names_an_unstable_loop(lbt_designs):
    _, rejection, noise = draw("sigma")(lbt_designs, sensor_gain=0.4).axes
    assert "0.4 times the sensor gain" in rejection.get_title(loc="left")
    for axis in (rejection, noise):
        assert "hinf: unstable" in legend(axis)
        curves = {line.get_label(): len(line.get_xdata()) for line in axis.get_lines()}
        assert curves["hinf: unstable"] == 0
        assert curves["kalman"] > 100


@pytest.mark.parametrize("near", [28, 60])
def test_a_grid_is_fine_around_lines_and_below_nyquist(near):
    grid = frequency_grid(800, (20.0, 390.0), points=240, near=near)
    assert np.all(np.diff(grid) > 0)
    assert (grid[0], grid[-1]) == pytest.approx((400 / 10**3.6, 400 * (1 - 1e-4)))
    assert {20.0, 390.0} < set(grid)
    for centre in (20.0, 390.0, 400.0):
        distances = np.sort(np.abs(grid / centre - 1))
        assert np.min(distances[distances > 0]) == pytest.approx(1e-4, rel=1e-6)
        assert np.max(np.diff(distances[distances < 0.1])) < 0.035


def curves_of(plant):
    """Singular values of a Kalman filter."""
    designs = {"kalman": lbt.kalman(plant)}
    return sigma_curves(designs, closed_loops(designs, 1.0))


def test_axes_that_do_not_mix_have_a_curve_each():
    """At a line of one axis the largest of both is that of the other, which rejects nothing."""
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.005, rms_nm=200, direction=along)
        for f, along in ((20, (1, 0)), (47, (0, 1)))
    ]
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20, frame_rate_hz=800)
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, vibrations=lines, noise_nm=10.0)
    curves = curves_of(plant)
    assert list(curves) == ["kalman, axis 1", "kalman, axis 2", "kalman"]
    for axis, line in ((1, 20), (2, 47)):
        own, other = (curves[f"kalman, axis {i}"] for i in (axis, 3 - axis))
        at = np.argmin(np.abs(own[0] - line))
        assert own[2][at] < 0.3 * other[2][at]
    assert curves["kalman"][1] is not None
    mixed = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=slow,
        vibrations=[replace(lines[0], direction=(1, 1))],
        noise_nm=10.0,
    )
    assert list(curves_of(mixed)) == ["kalman"]
