"""Figures: looks, legends, numbers; curves of closed forms, margins, spectra, unstable loops."""

import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from support.eris import eris_model
from support.pages import every_mark
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.loop.simulation import Drop, run_segments
from lbt_synth.report import draw
from lbt_synth.report.figures import loops, records, studies
from lbt_synth.storage.display_unit import own_display_unit, show_in
from lbt_synth.studies.limits import limits

PATH = lbt.LoopHardware(frame_rate_hz=800)
HALF = {"half": lbt.integrator(PATH, gain=0.5)}  # a phase margin of 46.57 degrees at 64.3 Hz
NAME = "half: 46.6° at 64.3 Hz, +6.0 dB"
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=800)
X, Y = ("x", ""), ("y", "")
LONG = "a very long name " * 3


def test_different_looks_differ():
    assert len({str(draw.line_style(i)) for i in range(36)}) == 36
    assert len({(draw.colour(i), draw.dot_style(i)["marker"]) for i in range(36)}) == 36
    assert draw.colour(None) not in [draw.colour(i) for i in range(36)]


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_titles_are_whole_and_stay_above_their_panel(columns):
    with draw.drawing([2.0] * columns, columns=columns) as panels:
        for panel in panels:
            draw.name_axes(panel, X, Y, LONG)
            panel.plot([0.0, 1.0], [0.0, 1.0], label="a")
    figure = panels[0].figure
    figure.draw_without_rendering()
    (names,) = figure.legends
    for axes in figure.axes:
        assert axes.get_title(loc="left").split() == LONG.split()
        title = axes._left_title.get_window_extent()
        assert title.x1 <= axes.get_window_extent().x1 + 1
        assert title.y1 <= names.get_window_extent().y0 + 1


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.1, 400, ["0.1", "1", "10", "100"]),
        (20, 300, ["20", "50", "100", "200"]),
        (64, 171, ["80", "100", "120", "140", "160"]),  # not 100 alone
    ],
)
def test_ticks_of_logarithmic_scales(low, high, texts):
    with draw.drawing([2.0]) as (panel,):
        draw.name_axes(panel, X, Y, yscale="log")
        panel.plot([0.0, 1.0, 2.0], [0.0, low, high])
    panel.figure.draw_without_rendering()
    bottom, top = panel.get_ylim()
    ticks = panel.yaxis.get_major_ticks()
    assert [t.label1.get_text() for t in ticks if bottom <= t.get_loc() <= top] == texts


def draw_two(axes=None):
    with draw.drawing([2.0, 2.0], axes=axes) as panels:
        for panel, name in zip(panels, ("first", "second"), strict=True):
            draw.name_axes(panel, ("frequency", "Hz"), Y)
            for middle in "ab":  # shortened alike, they stay two
                panel.plot([0.0, 1.0], label=name + 50 * "x" + middle + 50 * "x")
    return panels[0].figure


def test_a_figure_on_axes_of_the_user():
    axes = Figure().subplots(2, 1)
    assert draw_two(axes) is axes[0].figure
    assert axes[0].get_xlabel() == "frequency [Hz]"
    names = [[text.get_text() for text in one.get_legend().get_texts()] for one in axes]
    assert [[name[:6] for name in both] for both in names] == [["firstx"] * 2, ["second"] * 2]
    assert not axes[0].figure.legends
    assert len(draw_two().legends[0].get_texts()) == 4
    figure = Figure()
    with draw.drawing([2.0], axes=figure.subplots()) as (panel,):
        draw.draw_map([panel], [(np.arange(2.0), np.arange(2.0), np.eye(2))], "ratio [%]")
    assert figure.axes[1].get_xlabel() == "ratio [%]"  # of the colour bar


def test_numbers_are_those_that_are_drawn_in_the_unit_that_is_shown():
    lines, maps = (list(draw.figure_series(chart.figure)) for chart in every_mark())
    first, steps = (one for one in lines if one.name == "first")
    assert (first.heading, first.panel, steps.panel) == ("frequency [Hz]", "size [-]", "steps [nm]")
    np.testing.assert_allclose(first.x * first.y, 1.0)
    assert {one.name for one in lines} == {"first", "second", "dots"}  # no guides, no empty ones
    assert [one.name for one in maps[:2]] == [f"ratio [%] at gain [-] {x}" for x in (0.2, 0.4)]
    np.testing.assert_array_equal(maps[1].y, np.arange(6.0, 12.0))
    assert maps[0].panel == "first: gain [-]"
    with own_display_unit():
        show_in("mas", 10.0)
        _, other = (s for s in draw.figure_series(every_mark()[0].figure) if s.name == "first")
    assert other.panel == "steps [mas]"
    np.testing.assert_allclose(other.y, steps.y / 10)


def test_figures_are_files(tmp_path):
    for ending, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        content = draw.save_figure(draw_two(), tmp_path / f"f.{ending}").read_bytes()
        assert content.startswith(magic)
        assert len(content) < 400_000


def panels(kind, designs=HALF, **options):
    """The axes of a view."""
    return loops.loop_figure(designs, kind, **options).axes


def curves(axes, name):
    """Points (2, n) of each line of a name."""
    return [line.get_xydata().T for line in axes.get_lines() if line.get_label() == name]


def legend(axes):
    """Names of what is drawn in a plot, in order; the figure's legend shows those of all plots."""
    names = {panel: panel.get_legend_handles_labels()[1] for panel in axes.figure.axes}
    (shown,) = axes.figure.legends
    everywhere = {name for several in names.values() for name in several}
    assert sorted(text.get_text() for text in shown.get_texts()) == sorted(everywhere)
    return list(dict.fromkeys(names[axes]))


def test_a_bode_plot_has_the_gain_and_the_phase_of_the_closed_form():
    forms = (lambda f: -20 * np.log10(4 * np.sin(np.pi * f / 800)), lambda f: -90 - 540 * f / 800)
    rows = [
        ("loop gain [dB]", "gain margin", 800 / 6, 1e-6),
        ("phase [deg]", "phase margin", 800 / np.pi * np.arcsin(0.25), 1e-3),
    ]
    for axes, form, row in zip(panels("bode"), forms, rows, strict=True):
        heading, margin, margin_hz, error = row
        assert (legend(axes), axes.get_ylabel()) == ([NAME, margin], heading)
        ((f, values),) = curves(axes, NAME)
        assert values == pytest.approx(form(f), abs=error)
        (mark,) = curves(axes, margin)
        assert mark[:, 0] == pytest.approx((margin_hz, form(margin_hz)), abs=error)


def test_no_loop_of_a_nyquist_plot_enters_its_disks():
    (axes,) = panels("nyquist")
    names = ("loop", "modulus margin", "disk margin")
    (loop,), (modulus,), (disk,) = (([1, 1j] @ xy for xy in curves(axes, name)) for name in names)
    radius = np.abs(modulus + 1)
    assert np.ptp(radius) < 1e-9
    assert radius[0] <= np.nanmin(np.abs(loop + 1)) <= radius[0] * 1.001
    centre, radius = (disk.real.max() + disk.real.min()) / 2, np.ptp(disk.real) / 2
    assert 0 <= np.nanmin(np.abs(loop - centre)) / radius - 1 < 1e-3
    margins = lbt.loop_margins(lbt.close_loop(PATH, HALF["half"].controller))
    assert -disk.real.min() == pytest.approx(margins.disk_gain_high, rel=1e-3)
    title = f"half: disk {margins.disk:.2f}, modulus {margins.modulus:.2f}"
    assert axes.get_title(loc="left") == title


def test_the_contours_of_a_nichols_plot_are_at_their_distance_from_minus_one():
    (axes,) = panels("nichols")
    for modulus in (0.3, 0.5, 0.7):
        degrees, decibels = curves(axes, f"modulus {modulus:g}")[0]
        response = 10 ** (decibels / 20) * np.exp(1j * np.radians(degrees))
        assert np.abs(1 + response) == pytest.approx(modulus)
    marks = [curves(axes, name)[0][:, 0] for name in ("critical point", "phase margin")]
    np.testing.assert_allclose(marks, [(-180, 0), (-180 + 46.567, 0)], atol=1e-3)


@pytest.mark.parametrize("kind", ["bode", "nyquist", "step"])
def test_axes_that_differ_are_drawn_each(kind):
    uneven = replace(PATH, sensor_matrix=[[1.0, 0.0], [0.0, 0.5]])
    noisy = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=SLOW, noise_nm=[5.0, 50.0])
    for design, count in ((lbt.integrator(uneven, gain=0.5), 0), (lbt.kalman(noisy), 2)):
        names = legend(panels(kind, {"uneven": design})[0])  # the integrator inverts the sensor
        assert sum("axis" in name for name in names) == count


def test_an_unstable_loop_is_named_and_not_drawn(lbt_designs):
    for kind, place in (("bode", 0), ("nichols", 0), ("step", 0), ("sigma", 2), ("sigma", 1)):
        axes = panels(kind, lbt_designs, sensor_gain=0.4)[place]
        assert "hinf: unstable" in legend(axes)
        assert [curve.size for curve in curves(axes, "hinf: unstable")] == [0]
        kalman = next(name for name in legend(axes) if name.startswith("kalman"))
        assert curves(axes, kalman)[0].size > 100
    assert "0.4 times the sensor gain" in axes.get_title(loc="left")
    (axes,) = panels("nyquist", sensor_gain=2.5)
    assert axes.get_title(loc="left") == "half: unstable"
    assert not curves(axes, "loop")


def test_refusals():
    walk = lbt.kalman(lbt.EstimationProblem(A=0.99, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    fit = "axes must be 2 matplotlib Axes, one per panel; "
    rows = [
        (partial(draw_two, Figure().subplots()), f"{fit}got 1 (Axes)."),
        (partial(draw_two, Figure().subplots(3)), f"{fit}got 3 (Axes, Axes, Axes)."),
        (partial(draw_two, "above"), f"{fit}got 1 (str)."),
        (partial(draw_two, []), f"{fit}got 0 (none)."),
        *((partial(panels, kind, {}), "at least one design") for kind in loops.DRAWN),
        *((partial(panels, kind, {"walk": walk}), "walk is a filter of") for kind in loops.DRAWN),
    ]
    require_refusals((call, ProblemError, re.escape(words)) for call, words in rows)


@pytest.mark.parametrize("near", [28, 60])
def test_a_grid_is_fine_around_lines_and_below_nyquist(near):
    grid = loops.frequency_grid(800, (20.0, 390.0), points=240, near=near)
    assert np.all(np.diff(grid) > 0)
    assert (grid[0], grid[-1]) == pytest.approx((400 / 10**3.6, 400 * (1 - 1e-4)))
    assert {20.0, 390.0} < set(grid)
    for centre in (20.0, 390.0, 400.0):
        distances = np.sort(np.abs(grid / centre - 1))
        assert np.min(distances[distances > 0]) == pytest.approx(1e-4, rel=1e-6)
        assert np.max(np.diff(distances[distances < 0.1])) < 0.035


def test_axes_that_do_not_mix_have_a_curve_each():
    """At a line of one axis the largest of both is that of the other, which rejects nothing."""

    def sigma(*lines):
        vibrations = [
            lbt.Vibration(frequency_hz=f, damping=0.005, rms_nm=200, direction=direction)
            for f, direction in lines
        ]
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800, turbulence=SLOW, vibrations=vibrations, noise_nm=10.0
        )
        designs = {"kalman": lbt.kalman(plant)}
        return loops.sigma_curves(designs, loops.closed_loops(designs, 1.0))

    apart = sigma((20, (1, 0)), (47, (0, 1)))
    assert list(apart) == ["kalman, axis 1", "kalman, axis 2", "kalman"]
    for axis, line_hz in ((1, 20), (2, 47)):
        shaken, other = (apart[f"kalman, axis {i}"] for i in (axis, 3 - axis))
        place = np.argmin(np.abs(shaken[0] - line_hz))
        assert shaken[2][place] < 0.3 * other[2][place]
    assert apart["kalman"][1] is not None
    assert list(sigma((20, (1, 1)))) == ["kalman"]


def test_labels_of_a_short_spectrum_stay_apart_above_the_lines():
    model = eris_model()
    figure = records.identification_figure(model)
    figure.draw_without_rendering()
    labels = [text.get_text() for text in figure.axes[4].get_xticklabels() if text.get_text()]
    assert {"10", "20", "50"} <= set(labels)
    for plot, axis in zip(figure.axes[:2], model.axes, strict=True):
        assert len(plot.texts) == len(axis.lines)
        places = np.array([plot.transAxes.transform(text.get_position()) for text in plot.texts])
        # 6.5 points of type, and a little more
        assert np.all(np.diff(places[:, 0]) > 1.1 * 6.5 / 72 * figure.dpi)
        lines_hz = [line.frequency_hz for line in axis.lines]
        highest = np.max(np.interp(lines_hz, axis.frequency_hz, axis.fitted_nm2_hz))
        edges = plot.get_window_extent()
        assert edges.x0 < np.min(places[:, 0]) < np.max(places[:, 0]) < edges.x1
        assert np.all(places[:, 1] > plot.transData.transform((10, highest))[1])


@given(st.lists(st.floats(0, 1), max_size=40).map(sorted))
def test_labels_do_not_overlap(wanted):
    places = records.spread_labels(np.array(wanted), 0.045)
    assert places.size == len(wanted)
    assert np.all(np.diff(places) > min(0.045, 1 / max(len(wanted), 1)) - 1e-9)
    assert np.all((places > 0) & (places < 1))
    if wanted and np.all(np.diff([-0.03, *wanted, 1.03]) > 0.06):
        assert places == pytest.approx(wanted)


def test_a_simulation_has_the_spectrum_of_the_transfer_functions(config, lbt_designs):
    controller, path = lbt_designs["kalman"].controller, config.hardware
    run = lbt.simulate(controller, config.truth, hardware=path, frames=4000, cases=2)
    series, spectrum = records.simulation_figure(run, title="Kalman").axes
    assert series.get_xlabel() == "time [s]"
    assert "[nm²/Hz]" in spectrum.get_ylabel()
    f, _, simulated = records.run_spectra(run)
    exact = records.exact_spectrum(lbt.close_loop(path, controller), config.truth, f, 2048)
    assert np.mean((simulated / exact)[f > 5]) == pytest.approx(1, abs=0.06)


def test_spans_and_levels(sensors_design, sensors_config):
    drops = [Drop(unit="m1", start_s=0.5, end_s=1), Drop(unit="m1", start_s=1.5)]
    options = {"hardware": sensors_design.hardware, "frames": 2000, "drops": drops}
    run = lbt.simulate(sensors_design, sensors_config.truth, **options)
    levels_nm = [20.0, 60.0, 20.0, np.nan]
    figure = records.sensor_failure_figure(run, run_segments(drops, 2.0), levels_nm)
    series, rms = figure.axes
    assert len(series.patches) == len(rms.patches) == 2
    drawn = [line.get_ydata() for line in rms.lines]
    assert [float(y[0]) for y in drawn if len(y) == 2] == levels_nm[:3]
    (mean,) = (y for y in drawn if len(y) == 20)
    assert np.mean(np.square(mean)) == pytest.approx(float(run.rms_nm[0]) ** 2)  # as exact ones


def test_the_exact_spectrum_has_the_exact_power():
    path, length = lbt.LoopHardware(frame_rate_hz=800, modes=1), 2048
    air = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    shake = lbt.Vibration(frequency_hz=60, damping=0.05, rms_nm=40, direction=(1,))
    line = lbt.models.SinusoidalVibration(frequency_hz=31.7, rms_nm=30.0, direction=(1,))
    truth = lbt.Truth(turbulence=air, vibrations=(shake, line), noise_nm=5.0)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.4).controller)
    density = records.exact_spectrum(loop, truth, np.arange(length // 2 + 1) * 800 / length, length)
    power = np.sum(density[1:-1]) * 800 / length  # the ends hold half a bin
    exact = lbt.residual_budget(loop, truth)
    assert power == pytest.approx(exact.rms_nm**2 - exact.within_nm**2, rel=4e-3)


def test_residuals_over_the_frame_rate_have_logarithmic_axes():
    residuals_nm = {"integrator": np.array([900.0, 100.0]), "limit": np.array([140.0, 20.0])}
    (axis,) = studies.frame_rate_figure([200.0, 2000.0], residuals_nm).axes
    assert legend(axis) == ["integrator", "limit"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("frame rate [Hz]", "residual [nm rms]")
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    drawn = [line.get_ydata() for line in axis.get_lines()]
    assert np.array_equal(drawn, list(residuals_nm.values()))


def test_robustness_figure_draws_the_paper_beside(config):
    errors = {"errors_hz": [-1, 0, 1]}
    rows = list(lbt.studies.robustness(config.plant, config.truth, config.imaging, **errors))
    (axis,) = studies.robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", "H∞"]
    assert "[%]" in axis.get_ylabel()
    assert 50 < axis.get_ylim()[0] < 81  # the scale is that of what is there
    assert "[Hz]" in axis.get_xlabel()
    high = [replace(r, values=r.values | {"strehl": 0.99 + r.strehl / 1000}) for r in rows]
    assert 98.9 < studies.robustness_figure(high, {}).axes[0].get_ylim()[0] < 99.5


def test_a_sensor_gain_of_zero_has_no_line():
    """The interval goes on to the edge of the panel, where it has no end."""
    facts = {"family": "mixed", "rms": 1.0, "design": SimpleNamespace(hardware=True)}
    points = [
        SimpleNamespace(**facts, gamma=gamma, gain_low=low, gain_high=3)
        for gamma, low in ((1.0, 0.5), (2.0, 0.1), (3.0, 0.0))
    ]
    axes = studies.tradeoff_figure(points).axes[1]
    ends = [line.get_ydata() for line in axes.get_lines()[:2]]
    np.testing.assert_array_equal(ends, [[0.5, 0.1, np.nan], [3, 3, 3]])
    (shade,) = axes.collections
    assert shade.get_paths()[0].vertices[:, 1].min() == axes.get_ylim()[0] > 0.01


def test_a_map_hatches_the_unstable_region(config, lbt_designs):
    axes = {"errors_hz": [2, 0, -2, 1], "sensor_gains": [1.5, 0.3, 0.8, 3.0]}
    maps = {
        name: lbt.studies.robustness_map(lbt_designs[name], config.truth, config.imaging, **axes)
        for name in ("kalman", "hinf")
    }
    *maps_drawn, bar = studies.robustness_map_figure(maps).axes
    assert [panel.get_title(loc="left") for panel in maps_drawn] == ["kalman", "hinf"]
    assert (bar.get_xlabel(), maps_drawn[0].get_xlabel(), maps_drawn[0].get_ylabel()) == (
        "Strehl ratio [%]",
        "frequency error, truth less design [Hz]",
        "sensor gain [-]",
    )
    assert [panel.patch.get_hatch() for panel in maps_drawn] == ["////"] * 2
    meshes = [panel.collections[0] for panel in maps_drawn]
    # the Kalman filter at 3, the other at 0.3 as well
    assert [np.ma.count_masked(mesh.get_array()) for mesh in meshes] == [4, 8]
    assert meshes[0].get_clim() == meshes[1].get_clim()


def test_modal_figure_has_all_modes():
    residuals = {"integrators": np.array([9.0, 5, 2]), "Kalman filters": np.array([8.0, 4, 1])}
    facts = {"gains": np.array([0.5, 0.4, 0.3]), "turbulence_nm": np.array([90.0, 50.0, 20.0])}
    above, below = studies.modal_figure(residuals, **facts).axes
    assert (above.get_ylabel(), below.get_ylabel()) == ("integrator gain", "residual [nm rms]")
    assert [line.get_label() for line in below.get_lines()] == ["turbulence", *residuals]
    for line, values in zip(below.get_lines()[1:], residuals.values(), strict=True):
        np.testing.assert_array_equal(line.get_xydata().T, [[1, 2, 3], values])
    (gains,) = above.get_lines()
    assert gains.get_color() not in [line.get_color() for line in below.get_lines()]


def test_limits_name_designs_and_what_moves(config, lbt_designs):
    designs = {"kalman": lbt_designs["kalman"], "slow": lbt_designs["integrator"]}
    designs["old"] = designs["kalman"]
    study = limits(designs, config.hardware, config.truth, config.imaging, errors_hz=[-1, 1])
    (axes,) = studies.limits_figure(study).axes
    assert legend(axes)[:2] == ["slow", "Kalman, old"]
    assert axes.get_ylim()[0] < min(study.limit.rms_nm, study.residual_nm.min())
    assert axes.get_xlabel() == "frequency of the true vibration [Hz]"
    assert axes.get_ylabel() == "residual [nm rms]"
    assert len({str(line.get_linestyle()) for line in axes.get_lines()[:2]}) == 2
    several = studies.limits_figure(replace(study, frequency_hz=None)).axes[0].get_xlabel()
    assert several == "shift of the vibration that moves most, the others in proportion [Hz]"
