"""Parts of a study."""

from lbt_synth.studies.study.store import Part, missing_rows


def test_missing_rows(tmp_path):
    parts = [Part(start=a, stop=b, path=tmp_path) for a, b in [(2, 4), (4, 6), (9, 10)]]
    assert missing_rows(parts, 12) == [(0, 2), (6, 9), (10, 12)]
    assert missing_rows([], 5) == [(0, 5)]
    assert missing_rows(parts[:2], 6) == [(0, 2)]
