"""Tables as files."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any


def csv_bytes(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    r"""Return a CSV table as UTF-8, floats with all their digits.

    Examples
    --------
    >>> from lbt_synth.tables import csv_bytes
    >>> csv_bytes(["f_hz", "strehl"], [[20.0, 0.8]])
    b'f_hz,strehl\n20.0,0.8\n'
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    return buffer.getvalue().encode()
