"""Records whose commands are wrong in a known way."""

from __future__ import annotations

import numpy as np
from support.control_laws import ordinary_loop
from support.recorded_loops import RATE

import lbt_synth as lbt
from lbt_synth.identification.commands.repair import CommandRepair

TURN = np.deg2rad(30)
ROTATION = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])

FAULTS = {  # measurements and commands of the wrong record, and its repair
    "turned": (lambda y, u: (y, -u), CommandRepair(sign=(-1,))),
    "one turned": (lambda y, u: (y, u * [1, -1]), CommandRepair(sign=(1, -1))),
    "exchanged": (lambda y, u: (y, u[:, ::-1]), CommandRepair(swap_axes=True)),
    "rotated": (lambda y, u: (y, u @ ROTATION), CommandRepair(matrix=tuple(ROTATION.ravel()))),
    "1000 times": (lambda y, u: (y, 1000 * u), CommandRepair(scale=(0.001,))),
    "a tenth": (lambda y, u: (y, 0.1 * u), CommandRepair(scale=(10.0,))),
    "late": (lambda y, u: (y[1:], u[:-1]), CommandRepair(shift_frames=-1)),
    "early": (lambda y, u: (y[:-2], u[2:]), CommandRepair(shift_frames=2)),
    "early, turned": (lambda y, u: (y[:-2], -u[2:]), CommandRepair(shift_frames=2, sign=(-1,))),
    "increments": (
        lambda y, u: (y, np.diff(u, axis=0, prepend=0)),
        CommandRepair(increments=True),
    ),
}


def record(y, u, delay_frames: float = 2.0) -> lbt.identification.LoopRecord:
    """A record of these series."""
    return lbt.identification.loop_record(
        y, u, frame_rate_hz=RATE, delay_frames=delay_frames, unit="nm"
    )


def wrong_record(fault: str, seed: int = 1) -> lbt.identification.LoopRecord:
    """A record of an ordinary loop with one of the faults."""
    spoil, _ = FAULTS[fault]
    return record(*spoil(*ordinary_loop(seed)))
