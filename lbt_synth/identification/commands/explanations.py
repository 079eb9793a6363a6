"""What a guess about commands means: its fine values, the repair of the record, and its words."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess, is_orthogonal
from lbt_synth.identification.commands.repair import MIRROR, CommandRepair, rotation
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, IntArray

_FINE_DEG = np.arange(-24.0, 25.0, 6.0)
_SNAP_DEG = 10.0  # within which an angle is that of exchanged or turned axes
_LAW_DEG = 25.0  # within which it is that of the control law
_FINE_LEVELS = (0.86, 0.9, 0.95, 1.0, 1.05, 1.1)
_WORST_CONDITION = 100.0
_RIGHT_DEG = 0.5  # from a right angle


def invert_axes(gain: FloatArray) -> FloatArray | None:
    """Return the matrix of commands that makes a law's gain a number, of determinant 1 or -1.

    None if the gain cannot be inverted.
    """
    if np.linalg.cond(gain) > _WORST_CONDITION:
        return None
    inverse = np.linalg.inv(gain)
    return np.asarray(inverse / np.sqrt(abs(np.linalg.det(inverse))))


def refine_guess(coarse: CoarseRecord, guess: Guess, law: ControlLaw | None) -> Guess:
    """Return a guess with its angle or limits where they fit best."""
    if guess.limit_nm is not None:
        fine = [Guess(kind="clipped", limit_nm=x * guess.limit_nm) for x in _FINE_LEVELS]
        best = np.argmin(coarse.compare(fine).axis_contrast, axis=1)
        return Guess(kind="clipped", limit_nm=np.array(_FINE_LEVELS)[best] * guess.limit_nm)
    if guess.matrix is None or len(guess.matrix) == 1 or not guess.is_simple:
        return guess
    angle, mirrored = _angle_deg(guess.matrix)
    near = [_turn(angle + x, mirrored) for x in _FINE_DEG]
    contrast = coarse.compare([Guess(kind="matrix", matrix=m) for m in near]).contrast
    middle = int(np.clip(np.argmin(contrast), 1, len(near) - 2))
    near_best = slice(middle - 1, middle + 2)
    curve = np.polyfit(_FINE_DEG[near_best], contrast[near_best], 2)
    turn = -curve[1] / (2 * curve[0]) if curve[0] > 0 else _FINE_DEG[middle]
    angle += float(np.clip(turn, _FINE_DEG[0], _FINE_DEG[-1]))
    return Guess(kind="matrix", matrix=_turn(_snap(angle, mirrored, law), mirrored))


def _angle_deg(matrix: FloatArray) -> tuple[float, bool]:
    """Return the angle of a rotation, after a mirror of the second axis or without one."""
    mirrored = bool(np.linalg.det(matrix) < 0)
    turn = matrix @ MIRROR if mirrored else matrix
    return float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))), mirrored


def _turn(angle_deg: float, mirrored: bool) -> FloatArray:
    return rotation(angle_deg) @ MIRROR if mirrored else rotation(angle_deg)


def _snap(angle_deg: float, mirrored: bool, law: ControlLaw | None) -> float:
    """Return the angle of exchanged or turned axes, or that of the law, if it is near."""
    near = [-180.0, -90.0, 0.0, 90.0, 180.0]
    if law is not None and law.axis_matrix.kind not in ("zero", "general"):
        left, _, right = np.linalg.svd(law.gain)
        its_angle, its_mirror = _angle_deg((left @ right).T)
        if law.axis_matrix.kind in ("diagonal", "swapped"):  # what couples the axes is noise
            its_angle = 90.0 * round(its_angle / 90)
        if its_mirror == mirrored and _distance_deg(angle_deg, its_angle) < _LAW_DEG:
            near = [its_angle]
    nearest = min(near, key=lambda other: _distance_deg(angle_deg, other))
    snaps = _distance_deg(angle_deg, nearest) < (_LAW_DEG if len(near) == 1 else _SNAP_DEG)
    turned = nearest if snaps else float(np.round(angle_deg))
    return (turned + 180) % 360 - 180


def _distance_deg(one: float, other: float) -> float:
    return abs((one - other + 180) % 360 - 180)


def repair_guess(
    guess: Guess, delay_frames: float, lag: int
) -> tuple[CommandRepair, float | None, list[str]]:
    """Return the repair that a guess asks for, the delay if it is another, and the words."""
    if guess.matrix is not None:
        repair, why = _repair_matrix(guess.matrix)
        return repair, None, [why]
    if guess.kind == "increments":
        return CommandRepair(increments=True), None, ["they are increments, not positions"]
    if guess.limit_nm is not None:
        limits = tuple(float(f"{limit:.3g}") for limit in guess.limit_nm)
        most = " and ".join(f"{limit:g}" for limit in limits)
        why = f"they are requests, of which the mirror applied at most {most} nm"
        return CommandRepair(limit_nm=limits), None, [why]
    if guess.shift_frames == 0:
        return CommandRepair(), None, []
    words = []
    if lag:
        words = [f"they are recorded {count_text(lag, 'frame')} late"]
    total = delay_frames + guess.shift_frames + lag
    other = total if total != delay_frames else None
    if other is not None:
        words.append(f"the total delay is {other:g} frames, not {delay_frames:g}")
    return CommandRepair(shift_frames=-lag), other, words


def _repair_matrix(matrix: FloatArray) -> tuple[CommandRepair, str]:
    """Return the repair of a matrix from commands to axes of the measurements, and its words."""
    if len(matrix) == 1:
        return CommandRepair(sign=(-1,)), "they have the opposite sign"
    if not is_orthogonal(matrix):
        values = tuple(round(float(value), 4) for value in matrix.ravel())
        rows = ", ".join(f"{value:g}" for value in values)
        why = f"a matrix ({rows}) lies between them and the axes of the measurements"
        return CommandRepair(matrix=values), why
    angle, mirrored = _angle_deg(matrix)
    turns = round(angle / 90)
    if abs(angle - 90 * turns) > _RIGHT_DEG:
        repair = CommandRepair(rotation_deg=round(angle, 1), sign=(1, -1) if mirrored else ())
        way = "mirrored and rotated" if mirrored else "rotated"
        return repair, f"their axes are {way} by {abs(angle):g} degrees"
    exact = np.round(matrix)
    swapped = bool(exact[0, 0] == 0)
    one, other = (exact @ np.array([[0, 1], [1, 0]]) if swapped else exact).diagonal().astype(int)
    signs = int(one), int(other)
    words = ["those of the two axes are exchanged"] if swapped else []
    if signs == (-1, -1):
        words.append("they have the opposite sign")
    elif min(signs) < 0:
        words.append(f"axis {signs.index(-1)} has the opposite sign")
    sign = () if signs == (1, 1) else (-1,) if signs == (-1, -1) else signs
    return CommandRepair(swap_axes=swapped, sign=sign), " and ".join(words)


def recorded_early(frames: int) -> str:
    """Return the words for commands that know the future."""
    return f"they are recorded {count_text(frames, 'frame')} early, before their measurements"


def axes_apart(lags: IntArray) -> str:
    """Return the words for commands of two axes that follow their measurements differently."""
    late = int(np.argmax(lags))
    frames = int(np.ptp(lags))
    return (
        f"those of axis {late} follow their measurements {count_text(frames, 'frame')} later "
        f"than those of axis {1 - late}; move one of them"
    )


def wrong_scale(scale: FloatArray, gain: FloatArray) -> str:
    """Return the words for commands that need a factor on each axis, (axes,)."""
    sizes = [
        f"{1 / factor:g} times too large" if factor < 1 else f"{factor:g} times too small"
        for factor in scale
    ]
    words = f"they are {sizes[0]}"
    if np.ptp(scale):
        each = zip(sizes, scale, strict=True)
        words = " and ".join(
            f"those of axis {i} are {size}" for i, (size, factor) in enumerate(each) if factor != 1
        )
    gains = ", ".join(f"{value:.3g}" for value in gain)
    return f"{words} (with them the sensor has a gain of {gains})"
