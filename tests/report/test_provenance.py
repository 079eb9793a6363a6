"""The time at which a page was made."""

from datetime import UTC, datetime

import pytest

import lbt_synth as lbt
from lbt_synth.report.provenance import creation_time


def test_the_creation_time(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_time() == datetime(1970, 1, 2, tzinfo=UTC)
    for wrong in ("tomorrow", "1e400", str(10**30)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(lbt.errors.ProblemError, match="SOURCE_DATE_EPOCH must be a number"):
            creation_time()
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert abs((datetime.now(UTC) - creation_time()).total_seconds()) < 60
