"""Costs of the parts of a disturbance."""

import numpy as np
import pytest
from support.diagnoses import line_diagnosis

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.costs import disturbance_costs


@pytest.fixture(scope="module")
def found():
    return line_diagnosis()


def test_squares_add_up_to_the_budget(found):
    plant = found.model.plant()
    *parts, total = found.costs
    for field, controller in (
        ("running_nm", lbt.Controller(A=1.0, B=0.2, C=1.0, D=0.0, dt_s=1e-3)),
        ("best_nm", found.best_design.controller),
    ):
        exact = lbt.loop.model_budget(lbt.close_loop(plant.hardware, controller), plant)
        values = {row.part: getattr(row, field) for row in found.costs}
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
