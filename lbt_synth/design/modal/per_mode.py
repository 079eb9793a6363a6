"""Numbers, vibrations and names of modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import Vibration
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import FloatArray, frozen_copy, integer, real_array

Lines: TypeAlias = tuple[tuple[Vibration, ...], ...]
Vibrations: TypeAlias = Mapping[int, Vibration | Sequence[Vibration]]  # of some modes

_NAMED = 5  # modes that a message lists


def number_per_mode(
    value: Any, name: str, modes: int, *, zero: bool = False, at_most: float = np.inf
) -> FloatArray:
    """Return one positive number per mode, (n,), from one for all or one each."""
    given = real_array(value, name)
    if given.shape not in ((), (modes,)):
        got = f"shape {given.shape}"
        raise DimensionError(f"{name} must be one number, or one per mode ({modes}); got {got}.")
    low, high = float(np.min(given, initial=np.inf)), float(np.max(given, initial=-np.inf))
    if low < 0 or (low == 0 and not zero) or high > at_most:
        bounds = f"{'at least' if zero else 'above'} 0"
        if at_most < np.inf:
            bounds += f" and at most {at_most:g}"
        raise ProblemError(f"{name} must be {bounds}; got {low:.6g} to {high:.6g}.")
    return frozen_copy(np.broadcast_to(given, (modes,)))


def lines_per_mode(vibrations: Vibrations | None, modes: int) -> Lines:
    """Return the vibrations of each mode, along it, from a mapping of some modes."""
    lines: list[tuple[Vibration, ...]] = [()] * modes
    vibrations = {} if vibrations is None else vibrations
    if not isinstance(vibrations, Mapping):
        raise ProblemError(
            "vibrations must be a mapping from mode numbers to vibrations, such as {0: [line]}; "
            f"got {type(vibrations).__name__}."
        )
    for mode, some in vibrations.items():
        i = integer(mode, "a mode of vibrations", at_least=0, at_most=modes - 1)
        listed = (some,) if isinstance(some, Vibration) else some
        is_list = isinstance(listed, list | tuple)
        if not is_list or not all(isinstance(line, Vibration) for line in listed):
            raise ProblemError(f"mode {i} must have a list of Vibration; got {some!r}.")
        lines[i] = tuple(replace(line, direction=(1.0,)) for line in listed)
    return tuple(lines)


def mode_indices(indices: Any, name: str, n: int) -> np.ndarray:
    """Return different mode numbers from 0 to n - 1 as an integer array."""
    if isinstance(indices, str | bytes) or not np.iterable(indices):
        raise ProblemError(f"{name} must be a list of mode numbers; got {indices!r}.")
    out = [integer(index, name, at_least=0) for index in indices]
    if not out:
        raise ProblemError(f"{name} must name at least one mode; got none.")
    if len(set(out)) != len(out) or any(index >= n for index in out):
        raise ProblemError(f"{name} must be different mode numbers from 0 to {n - 1}; got {out}.")
    return np.array(out, dtype=np.intp)


def name_modes(indices: Any) -> str:
    """Text that names some modes: "mode 3", "modes 3, 7, 8 and 12 more"."""
    numbers = [str(int(i)) for i in indices]
    if len(numbers) == 1:
        return f"mode {numbers[0]}"
    if len(numbers) > _NAMED:
        numbers = [*numbers[:_NAMED], f"{len(numbers) - _NAMED} more"]
    return f"modes {listing_text(numbers)}"
