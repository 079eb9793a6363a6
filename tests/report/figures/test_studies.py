"""The figures of studies: of a set of modes."""

import pytest

import lbt_synth as lbt


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
    (gains,) = above.get_lines()
    assert gains.get_color() not in [line.get_color() for line in below.get_lines()]
    assert len(lbt.report.figures.modal_figure({"one": [1.0]}).axes) == 1


def test_bad_modal_figures_are_refused():
    for arguments, error, words in (
        (({},), lbt.errors.ProblemError, "got none"),
        (({"a": [1.0, 0.0]},), lbt.errors.ProblemError, "a must be above 0"),
        (({"a": 1.0},), lbt.errors.DimensionError, "one number per mode"),
        (({"a": [1.0], "b": [1.0, 2.0]},), lbt.errors.DimensionError, "b must have 1 modes"),
    ):
        with pytest.raises(error, match=words):
            lbt.report.figures.modal_figure(*arguments)
