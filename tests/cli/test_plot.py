"""The command plot: figures, tables and curves."""

import csv
import json

import numpy as np
import pytest
from support.commands import run

VIEWS = ("bode", "nyquist", "nichols", "step", "sigma")


@pytest.mark.parametrize("view", VIEWS)
def test_a_view_writes_its_figure_and_its_points(view, tmp_path, capsys, gains):
    figure, table = tmp_path / f"{view}.png", tmp_path / f"{view}.csv"
    status, text, _ = run(
        capsys, "plot", view, gains["kalman"], gains["integrator"], "-o", figure, "-o", table
    )
    assert status == 0
    assert text.startswith("kalman survives 0.47 frames more delay")
    assert figure.read_bytes().startswith(b"\x89PNG")
    data = json.loads(run(capsys, "plot", view, gains["kalman"], gains["integrator"], "--json")[1])
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["design"] for row in rows} == set(data["curves"]) == {"kalman", "integrator"}
    for name, curves in data["curves"].items():
        for quantity, values in curves.items():
            written = [float(row[quantity]) for row in rows if row["design"] == name]
            assert written == values
    assert "error" in data["curves"]["kalman"] or view != "sigma"
    assert "error" not in data["curves"]["integrator"]


def test_points_of_a_loop_are_those_of_an_integrator(capsys, gains):
    data = json.loads(run(capsys, "plot", "nyquist", gains["integrator"], "--json")[1])
    found = {name: np.array(values) for name, values in data["curves"]["integrator"].items()}
    z = np.exp(2j * np.pi * found["frequency_hz"] / 800)
    expected = 0.5 * z**-2 / (1 - 1 / z)
    assert found["real"] + 1j * found["imaginary"] == pytest.approx(expected, rel=1e-6)
    assert found["gain_db"] == pytest.approx(20 * np.log10(np.abs(expected)), abs=1e-6)
    assert (data["units"]["gain_db"], data["units"]["phase_deg"]) == ("dB", "deg")


def test_overshoot_and_settling_time(capsys, gains):
    status, text, _ = run(capsys, "plot", "step", gains["integrator"])
    assert status == 0
    assert "settling time, to 5 % [ms]" in text
    (row,) = json.loads(run(capsys, "plot", "step", gains["integrator"], "--json")[1])["steps"]
    assert row["overshoot_percent"] == pytest.approx(25.0)  # 1, 1, 0.5, 0, -0.25, -0.25, ...


def test_without_a_stable_loop_there_is_nothing_to_draw(tmp_path, capsys, gains):
    out = tmp_path / "bode.csv"
    status, _, error = run(
        capsys, "plot", "bode", gains["integrator"], "--gain-factor", 3, "-o", out
    )
    assert (status, out.exists()) == (1, False)
    assert "no loop is stable at 3 times the sensor gain" in error
