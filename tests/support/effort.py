"""How much Python a call runs: a clock would show how busy the machine is."""

import sys


def count_calls(function, *arguments, **options):
    """Return how many functions of Python and C a call enters: as many for a long array."""
    count = 0

    def enter(_frame, event, _argument):
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(enter)
    try:
        function(*arguments, **options)
    finally:
        sys.setprofile(before)
    return count
