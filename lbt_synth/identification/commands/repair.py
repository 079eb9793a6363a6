"""What turns the commands of a record into those that its mirror followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, integer, number, read_only, real_array


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRepair:
    """A correction of recorded commands, in the order of the fields."""

    increments: bool = False  # they are increments, to be added up
    shift_frames: int = 0  # by which they move to later frames
    swap_axes: bool = False
    sign: tuple[int, ...] = ()  # 1 or -1 for each axis, or for both
    matrix: tuple[float, ...] = ()  # to the axes of the measurements, in rows
    scale: tuple[float, ...] = ()  # of both axes, or of each
    delay_frames: float | None = None  # total delay of the loop

    def __post_init__(self) -> None:
        for factor in self.scale:
            number(factor, "command_scale", above=0)
        integer(self.shift_frames, "command_shift_frames")
        if any(sign not in (-1, 1) for sign in self.sign):
            raise ProblemError(f"command_sign must be 1 or -1, per axis; got {list(self.sign)}.")
        real_array(self.matrix, "command_matrix")

    @property
    def options(self) -> str:
        """The options of the command line that do the same."""

        def values(numbers: Sequence[float]) -> str:
            return " ".join(f"{value:g}" for value in numbers)

        words = [
            "--command-increments" if self.increments else "",
            f"--command-shift-frames {self.shift_frames}" if self.shift_frames else "",
            "--swap-axes" if self.swap_axes else "",
            f"--command-sign {values(self.sign)}" if self.sign else "",
            f"--command-matrix {values(self.matrix)}" if self.matrix else "",
            f"--command-scale {values(self.scale)}" if self.scale else "",
            "" if self.delay_frames is None else f"--delay-frames {self.delay_frames:g}",
        ]
        return " ".join(filter(None, words))

    def words(self) -> list[str]:
        """Return what is wrong with commands that need this."""
        out = []
        if self.shift_frames:
            frames = count_text(abs(self.shift_frames), "frame")
            when = "late" if self.shift_frames < 0 else "early, before their measurements"
            out.append(f"they are recorded {frames} {when}")
        if self.matrix:
            rows = ", ".join(f"{value:.4g}" for value in self.matrix)
            out.append(f"between them and the axes of the measurements lies a matrix ({rows})")
        if self.increments:
            out.append("they are increments, not positions")
        if self.swap_axes:
            out.append("those of the two axes are exchanged")
        if self.sign:
            turned = self.sign.index(-1)
            one = len(set(self.sign)) == 1
            out.append(f"{'they have' if one else f'axis {turned} has'} the opposite sign")
        if self.delay_frames is not None:
            out.append(f"the total delay is {self.delay_frames:g} frames")
        for axis, factor in enumerate(self.scale):
            if factor != 1:
                whose = "they" if len(self.scale) == 1 else f"those of axis {axis}"
                size = f"{max(factor, 1 / factor):g} times too {'large' if factor < 1 else 'small'}"
                out.append(f"{whose} are {size}")
        return out

    def turn(self, axes: int) -> FloatArray:
        """Return the matrix that swap, sign, matrix and scale are together."""
        if axes != 2 and self.swap_axes:
            raise ProblemError(
                "swapped commands need two axes; the record has one. Leave "
                f"{self.options} out, or choose two columns."
            )
        if self.matrix and len(self.matrix) != axes**2:
            raise ProblemError(
                f"command_matrix must have {axes**2} numbers for {axes} axes, row after row; "
                f"got {len(self.matrix)}."
            )
        out = np.eye(axes)[::-1] if self.swap_axes else np.eye(axes)
        out = _per_axis(self.sign, "command_sign", axes) * out
        if self.matrix:
            out = np.reshape(self.matrix, (axes, axes)) @ out
        return _per_axis(self.scale, "command_scale", axes) * out


def _per_axis(values: Sequence[float], name: str, axes: int) -> FloatArray:
    """Return the factor of each row, (axes, 1), of none, one for all axes, or one for each."""
    if len(values) not in (0, 1, axes):
        raise ProblemError(f"{name} must be one number, or {axes}; got {list(values)}.")
    return np.reshape(np.broadcast_to(np.array(values or 1.0, dtype=np.float64), axes), (axes, 1))


def repair_commands(record: LoopRecord, repair: CommandRepair) -> LoopRecord:
    """Return a closed-loop record with the commands that the mirror followed."""
    if record.commands is None:
        raise ProblemError("the record is of an open loop: it has no commands to repair.")
    commands, good = np.array(record.commands), np.array(record.commanded)
    if repair.increments:
        commands = np.cumsum(commands, axis=0)
        good &= np.logical_and.accumulate(good)
    if repair.shift_frames:
        commands = np.roll(commands, repair.shift_frames, axis=0)
        good = np.roll(good, repair.shift_frames)
        late = repair.shift_frames > 0
        unknown = slice(0, repair.shift_frames) if late else slice(repair.shift_frames, None)
        commands[unknown], good[unknown] = 0.0, False
    commands = commands @ repair.turn(record.axes).T
    repaired = replace(record, commands=read_only(commands), commanded=read_only(good))
    return repaired.with_delay(repair.delay_frames or record.delay_frames)
