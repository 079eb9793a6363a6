"""How much Python a call runs: a clock would show how busy the machine is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


def count_calls(function: Callable[..., Any], *arguments: Any, **options: Any) -> int:
    """Return how many functions of Python and C a call enters.

    What works on whole arrays enters as many for long ones as for short ones.
    """
    count = 0

    def enter(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(enter)
    try:
        function(*arguments, **options)
    finally:
        sys.setprofile(before)
    return count
