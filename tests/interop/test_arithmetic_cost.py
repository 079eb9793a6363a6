"""Counts of the arithmetic and memory of a frame."""

import re

import pytest

import lbt_synth as lbt


def test_costs_by_hand():
    controller = lbt.Controller(
        A=[[1.0, 0.5], [0.0, -1.0]], B=[[2.0], [0.0]], C=[[1.0, 1.0], [0.0, 0.0]], D=[[0.0], [3.0]]
    )
    cost = lbt.interop.frame_cost(controller)
    # x0 + .5 x1 + 2 y; -x1; n0 + n1; 3 y
    assert (cost.multiplications, cost.additions, cost.coefficients, cost.states) == (3, 3, 3, 4)
    assert (cost.dense_multiplications, cost.dense_additions, cost.dense_coefficients) == (
        12,
        8,
        12,
    )
    assert (cost.coefficient_bytes_double, cost.coefficient_bytes_single) == (24, 12)
    assert (cost.state_bytes_double, cost.state_bytes_single) == (32, 16)


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_costs_are_those_of_the_source(tmp_path, designs, name):
    text = lbt.interop.export_c(tmp_path / "k.c", designs[name]).files[0].read_text()
    body = text.split("k_step(k_state", 1)[1].split("{", 1)[1]
    cost = lbt.interop.frame_cost(designs[name])
    assert body.count(" * ") == cost.multiplications
    assert body.count(" + ") + body.count(" - ") == cost.additions


def test_costs_of_whole_matrices(tmp_path, designs):
    cost = lbt.interop.frame_cost(designs["turned"])
    n = designs["turned"].controller.n_states
    assert cost.multiplications == cost.dense_multiplications == (n + 2) ** 2
    text = lbt.interop.export_c(tmp_path / "k.c", designs["turned"]).files[0].read_text()
    assert len(re.findall(r"/\* \[\d+\]\[\d+\] = ", text)) == cost.coefficients


def test_costs_need_a_controller():
    with pytest.raises(lbt.errors.ProblemError, match="must be a Controller, or a design; got int"):
        lbt.interop.frame_cost(3)


def test_both_forms_are_met(designs):
    for name in ("kalman", "hinf", "integrator", "prior"):
        assert lbt.interop.frame_cost(designs[name]).form == "straight line"
    assert lbt.interop.frame_cost(designs["turned"]).form == "loops"
