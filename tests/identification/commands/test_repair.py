"""Repairs of recorded commands: each undoes its fault."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.refusals import refused
from support.wrong_commands import FAULTS, record, wrong_record

import lbt_synth as lbt
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands


@pytest.mark.parametrize("fault", ["one turned", "rotated", "a tenth", "late", "increments"])
def test_a_repair_undoes_its_fault(fault) -> None:
    y, u = ordinary_loop()
    repaired = repair_commands(wrong_record(fault), FAULTS[fault][1])
    good = record(y, u)
    start = 1 if fault == "late" else 0  # the measurement of the first frame was lost with it
    usable = np.flatnonzero(repaired.usable)
    assert usable.size > 9980
    c, expected = repaired.corrections(), good.corrections()[start:]
    np.testing.assert_allclose(c[usable], expected[usable], atol=1e-9 * np.max(abs(u)))
    np.testing.assert_array_equal(repaired.measurements[usable], good.measurements[start:][usable])


def test_frames_whose_command_is_not_known_are_not_usable() -> None:
    y, u = ordinary_loop()
    u = u.copy()
    u[5000] = np.nan
    seen = record(y, u)
    later = repair_commands(seen, CommandRepair(shift_frames=3))
    assert not later.usable[5005]
    assert later.usable[5004]
    assert later.usable[5006]
    assert not later.usable[:5].any()  # three frames of the shift and two of the delay
    summed = repair_commands(seen, CommandRepair(increments=True))
    assert summed.usable[5001]
    assert not summed.usable[5002:].any()  # every later position depends on the lost increment


def test_the_matrix_of_a_repair_is_applied_in_the_order_of_its_fields() -> None:
    both = CommandRepair(swap_axes=True, sign=(1, -1), matrix=(1.0, 2.0, 3.0, 4.0), scale=(2.0,))
    swap, sign = np.array([[0, 1], [1, 0]]), np.diag([1, -1])
    np.testing.assert_allclose(both.turn(2), 2 * np.array([[1, 2], [3, 4]]) @ sign @ swap)
    assert CommandRepair(scale=(500.0, 480.0)).turn(2).tolist() == [[500.0, 0.0], [0.0, 480.0]]
    assert both.options == (
        "--swap-axes --command-sign 1 -1 --command-matrix 1 2 3 4 --command-scale 2"
    )


def test_repairs_that_are_refused() -> None:
    y, u = ordinary_loop()
    one = record(y[:, :1], u[:, :1])
    open_loop = lbt.identification.loop_record(y, frame_rate_hz=1000, unit="nm")

    def repair(seen, **fields):
        return repair_commands(seen, CommandRepair(**fields))

    for call, why in (
        (lambda: CommandRepair(sign=(2,)), "command_sign must be 1 or -1"),
        (lambda: CommandRepair(scale=(1.0, -2.0)), "command_scale must be above 0"),
        (lambda: CommandRepair(matrix=(1.0, np.nan, 0.0, 1.0)), "command_matrix"),
        (lambda: CommandRepair(scale=(5.0, 4.0)).turn(1), "command_scale must be one number, or 1"),
        (lambda: repair(one, swap_axes=True), "need two axes"),
        (lambda: repair(one, sign=(1, -1)), "command_sign must be one number, or 1"),
        (lambda: repair(one, matrix=(1.0, 0.0, 0.0, 1.0)), "must have 1 numbers"),
        (lambda: repair(open_loop, sign=(-1,)), "open loop"),
    ):
        refused(call, lbt.errors.ProblemError, why)
