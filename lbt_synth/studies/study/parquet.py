"""Parquet tables, in the only module that imports pyarrow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lbt_synth.errors import MissingExtraError, OutputError
from lbt_synth.validation import FloatArray


def require_parquet() -> None:
    """Refuse to go on without pyarrow."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            'results: parquet needs pyarrow; try: pip install "lbt-synth[parquet]", or results: '
            "csv.",
            extra="parquet",
        ) from error


def write_parquet(stream: BinaryIO, names: Sequence[str], blocks: Iterable[FloatArray]) -> None:
    """Write blocks (n, columns) of rows, of which the first column has integers."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = [pa.int64(), *[pa.float64()] * (len(names) - 1)]
    schema = pa.schema(list(zip(names, kinds, strict=True)))
    with pq.ParquetWriter(stream, schema) as writer:
        for block in blocks:
            arrays = [pa.array(c, kind) for c, kind in zip(block.T, kinds, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


def read_parquet(path: Path) -> dict[str, FloatArray]:
    """Return all columns of a file, (n,) each."""
    require_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table: Any = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise OutputError(f"cannot read {path}: {error}.", path=path) from error
    return {name: table[name].to_numpy().astype(np.float64) for name in table.column_names}
