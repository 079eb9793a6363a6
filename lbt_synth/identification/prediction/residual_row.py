"""The printed row of a comparison on unseen data."""

from __future__ import annotations

from lbt_synth.storage.rows import column, nm_column, table_row


@table_row
class ResidualRow:
    """One controller on frames that nothing was fitted to, beside what the model promises."""

    name: str = column("controller", help="What it is")
    replayed_nm: float = nm_column(
        "data", format=".2f", key="data_nm", help="Residual on the data, all axes"
    )
    replayed_error_nm: float = nm_column(
        "+-", format=".2f", key="data_error_nm", help="Its standard error"
    )
    model_nm: float = nm_column("model", format=".2f", help="Residual that the model promises")
    ratio: float = column("data/model", format=".3f", help="Residual on the data over that")
    strehl: float = column("Strehl, data", format=".3f", help="Strehl ratio on the data")
    model_strehl: float = column("Strehl, model", format=".3f", help="Strehl ratio by the model")
