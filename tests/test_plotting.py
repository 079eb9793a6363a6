from __future__ import annotations

import pytest

import lbt_synth as lbt
from lbt_synth.report.figures.style import save_figure


@pytest.fixture
def designs(config):
    return {
        "Kalman": lbt.kalman(config.plant),
        "H-infinity": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
        "integrator": lbt.integrator(config.hardware, gain=0.5),
    }


def legend(axis):
    return [text.get_text() for text in axis.get_legend().get_texts()]


def test_sigma_figure_has_labels_units_and_marked_vibrations(designs):
    error, rejection, noise = lbt.report.figures.sigma_figure(designs).axes
    assert legend(error) == ["Kalman", "H-infinity", "vibration"]
    assert legend(rejection) == ["Kalman", "H-infinity", "integrator", "vibration"]
    assert "[nm]" in error.get_ylabel()
    assert noise.get_xlabel() == "frequency [Hz]"
    marks = [line for line in error.get_lines() if line.get_label() == "vibration"]
    assert marks[0].get_xdata()[0] == 20
    # the curve is the achieved norm at its highest point
    curve = error.get_lines()[0].get_ydata()
    assert curve.max() == pytest.approx(designs["Kalman"].gamma, rel=1e-3)


def test_curves_are_told_apart_in_grey(designs):
    lines = lbt.report.figures.sigma_figure(designs).axes[1].get_lines()[:3]
    assert len({str(line.get_linestyle()) for line in lines}) == 3
    assert len({line.get_color() for line in lines}) == 3


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_figures_are_files(tmp_path, designs, ending):
    path = save_figure(lbt.report.figures.sigma_figure(designs), tmp_path / f"f.{ending}")
    magic = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[ending]
    assert path.read_bytes().startswith(magic)
    assert path.stat().st_size < 400_000


def test_other_endings_are_refused(tmp_path, designs):
    with pytest.raises(lbt.errors.OutputError, match=r"must end in .png, .pdf, .svg; got 'f.gif'"):
        save_figure(lbt.report.figures.sigma_figure(designs), tmp_path / "f.gif")


def test_robustness_figure_draws_the_paper_beside(config):
    rows = list(
        lbt.studies.robustness(config.plant, config.truth, config.imaging, errors_hz=[-1, 0, 1])
    )
    (axis,) = lbt.report.figures.robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", r"H$_\infty$"]
    assert "[%]" in axis.get_ylabel()
    assert "[Hz]" in axis.get_xlabel()


def test_simulation_figure(config):
    run = lbt.simulate(
        lbt.kalman(config.plant).controller, config.truth, hardware=config.hardware, frames=600
    )
    series, spectrum = lbt.report.figures.simulation_figure(run, title="Kalman").axes
    assert series.get_xlabel() == "time [s]"
    assert "[nm$^2$/Hz]" in spectrum.get_ylabel()


def test_empty_figures_are_refused():
    for empty in (
        lambda: lbt.report.figures.sigma_figure({}),
        lambda: lbt.report.figures.loop_figure({}),
        lambda: lbt.report.figures.robustness_figure([]),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="at least one"):
            empty()


def test_an_unstable_loop_is_named_and_not_drawn(designs):
    _, rejection, noise = lbt.report.figures.sigma_figure(designs, sensor_gain=0.4).axes
    assert "sensor gain 0.4" in rejection.get_title(loc="right")
    for axis in (rejection, noise):
        assert "H-infinity: unstable" in legend(axis)
        curves = {line.get_label(): len(line.get_xdata()) for line in axis.get_lines()}
        assert curves["H-infinity: unstable"] == 0
        assert curves["Kalman"] > 100


def test_robustness_figure_of_an_unstable_method(config):
    from dataclasses import replace

    truth = replace(config.truth, sensor_gain=0.3)
    rows = list(
        lbt.studies.robustness(
            config.plant, truth, config.imaging, errors_hz=[-1, 0], gamma_ratio=1.05
        )
    )
    (axis,) = lbt.report.figures.robustness_figure(rows).axes
    assert legend(axis) == ["Kalman", r"H$_\infty$: unstable"]


def test_modal_figure_has_labels_units_and_all_modes():
    residuals = {"integrators": [9.0, 5.0, 2.0], "Kalman filters": [8.0, 4.0, 1.0]}
    above, below = lbt.report.figures.modal_figure(
        residuals, gains=[0.5, 0.4, 0.3], turbulence_nm=[90.0, 50.0, 20.0]
    ).axes
    assert above.get_ylabel() == "integrator gain"
    assert below.get_ylabel() == "residual [nm rms]"
    assert below.get_xlabel().startswith("mode")
    assert [line.get_label() for line in below.get_lines()] == ["turbulence", *residuals]
    for line, values in zip(below.get_lines()[1:], residuals.values(), strict=True):
        assert line.get_xdata().tolist() == [1, 2, 3]
        assert line.get_ydata().tolist() == values
    assert len(lbt.report.figures.modal_figure({"one": [1.0]}).axes) == 1


def test_bad_modal_figures_are_refused():
    for arguments, error, words in (
        (({},), lbt.errors.ProblemError, "got none"),
        (({"a": [1.0, 0.0]},), lbt.errors.ProblemError, "a must be above 0"),
        (({"a": 1.0},), lbt.errors.DimensionError, "one number a mode"),
        (({"a": [1.0], "b": [1.0, 2.0]},), lbt.errors.DimensionError, "b must have 1 modes"),
    ):
        with pytest.raises(error, match=words):
            lbt.report.figures.modal_figure(*arguments)
