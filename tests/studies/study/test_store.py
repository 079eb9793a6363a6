"""Parts and tables of a study."""

from __future__ import annotations

import pytest
from support.studies import TWO, evaluate_quickly, load_small_study, make_folder

import lbt_synth as lbt
from lbt_synth.errors import MissingExtraError
from lbt_synth.studies.study.store import missing_rows


def test_missing_rows(tmp_path):
    from lbt_synth.studies.study.store import Part

    parts = [Part(start=a, stop=b, path=tmp_path) for a, b in [(2, 4), (4, 6), (9, 10)]]
    assert missing_rows(parts, 12) == [(0, 2), (6, 9), (10, 12)]
    assert missing_rows([], 5) == [(0, 5)]
    assert missing_rows(parts[:2], 6) == [(0, 2)]


def test_parquet_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    study = load_small_study(tmp_path, results="parquet")
    with pytest.raises(MissingExtraError, match=r'pip install "lbt-synth\[parquet\]"'):
        lbt.studies.run_study(study, make_folder(tmp_path))


@pytest.mark.e2e
def test_parquet(tmp_path):
    import pyarrow.parquet as pq

    study = load_small_study(tmp_path, samples="70", results="parquet", controllers=TWO)
    folder = make_folder(tmp_path)
    run = lbt.studies.run_study(study, folder, evaluate=evaluate_quickly)
    assert run.results.name == "results.parquet"
    found = pq.read_table(run.results)
    assert tuple(found.column_names) == study.columns
    assert str(found.schema.field("row").type) == "int64"
    assert found["row"].to_pylist() == list(range(70))
    expected = evaluate_quickly(study, study.values(), 0).columns
    for name in study.result_columns:
        assert found[name].to_pylist() == expected[name].tolist()  # all digits
    assert lbt.studies.replay_row(study, folder, 69).stored["a.strehl"] == expected["a.strehl"][69]
    assert lbt.studies.run_study(study, folder, evaluate=None).computed == 0
