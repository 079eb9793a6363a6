"""Where lines come from: their direction, with an error that covers the truth.

Costs of the parts of a disturbance.
"""

from functools import cache

import numpy as np
import pytest
from support.control_laws import PATH, RATE
from support.diagnoses import line_diagnosis
from support.recorded_loops import slow

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.line_origins import disturbance_costs, line_origins

ANGLES = {20.0: 0.0, 37.0: 90.0, 61.0: 30.0, 90.0: -40.0}  # by frequency [Hz]


def line(frequency, direction, rms=60.0):
    return lbt.Vibration(frequency_hz=frequency, damping=0.006, rms_nm=rms, direction=direction)


def recorded(vibrations, seed, frames=16_384):
    truth = lbt.Truth(turbulence=slow(), vibrations=vibrations, noise_nm=8.0, sensor_gain=0.7)
    run = lbt.simulate(
        lbt.integrator(PATH, gain=0.3).controller, truth, hardware=PATH, frames=frames, seed=seed
    )
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )


@cache
def several():
    lines = tuple(
        line(f, (np.cos(np.radians(angle)), np.sin(np.radians(angle))))
        for f, angle in ANGLES.items()
    )
    return line_origins(lbt.identify(recorded(lines, seed=2), sensor_gain=0.7))


def test_each_line_has_its_direction():
    rows = {round(each.frequency_hz): each for each in several()}
    assert sorted(rows) == [20, 37, 61, 90]
    for frequency, angle in ANGLES.items():
        row = rows[frequency]
        apart = (row.direction_deg - angle + 90) % 180 - 90
        if frequency in (20.0, 37.0):  # of one axis alone
            assert abs(apart) < 6
        else:
            assert abs(apart) < 4 * row.direction_error_deg < 12
        assert row.rms_nm == pytest.approx(60, rel=0.35)
    origins = [rows[f].origin for f in sorted(rows)]
    assert origins == ["tip", "tilt", "a diagonal", "a diagonal"]


def test_a_diagonal_is_one_vibration():
    by_frequency = {round(row.frequency_hz): row for row in several()}
    assert min(np.abs(by_frequency[61].vibration.direction)) > 0.4
    assert by_frequency[61].name.startswith("line at 6")


@pytest.fixture(scope="module")
def found():
    return line_diagnosis()


def test_squares_add_up_to_the_budget(found):
    plant = found.model.plant()
    running = lbt.Controller(A=1.0, B=0.2, C=1.0, D=0.0, dt_s=1e-3)
    best = found.best_design.controller
    costs = disturbance_costs(plant, found.lines, running, best, lbt.Imaging())
    *parts, total = costs
    for field, controller in (("running_nm", running), ("best_nm", best)):
        loop = lbt.close_loop(plant.hardware, controller)
        exact = lbt.residual_budget(loop, plant, frame_means=True)
        values = {row.part: getattr(row, field) for row in costs}
        assert values["all"] == pytest.approx(exact.rms_nm, rel=1e-6)
        assert values["measurement noise"] == pytest.approx(exact.noise_nm, rel=1e-6)
        assert np.hypot.reduce([getattr(row, field) for row in parts]) == pytest.approx(
            values["all"]
        )
    ordered = [row.running_nm for row in parts]
    assert ordered == sorted(ordered, reverse=True)
    assert total.part == "all"


def test_strehl_ratio_that_a_part_costs(found):
    total = found.costs[-1]
    lost = 1 - lbt.loop.jitter_strehl([[total.running_nm**2]], imaging=lbt.Imaging())
    assert total.running_strehl == pytest.approx(lost, rel=1e-6)
    line = found.costs[0]
    rest = total.running_nm**2 - line.running_nm**2
    without = lbt.loop.jitter_strehl([[rest]], imaging=lbt.Imaging())
    assert line.running_strehl == pytest.approx(without - (1 - lost), rel=1e-6)


def test_loops_that_are_not_known_cost_nothing_that_is_known(found):
    plant = found.model.plant()
    wild = lbt.Controller(A=1.0, B=5.0, C=1.0, D=0.0, dt_s=1e-3)
    rows = disturbance_costs(plant, found.lines, wild, found.best_design.controller, lbt.Imaging())
    assert all(np.isnan([row.running_nm, row.running_strehl]).all() for row in rows)
    assert [row.best_nm for row in rows[:-1]] == sorted(
        (r.best_nm for r in rows[:-1]), reverse=True
    )
    assert disturbance_costs(plant, found.lines, None, None, lbt.Imaging()) == ()
