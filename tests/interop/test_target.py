"""The targets of an export."""

from __future__ import annotations

from dataclasses import astuple

import pytest
from support.written_files import ORACLES, WITHOUT_ORACLE, judge

import lbt_synth as lbt
from lbt_synth.interop import export_checks
from lbt_synth.interop.target import target_names

CHUNK = 100


@pytest.mark.parametrize("name", target_names())
def test_a_target_says_how_it_computes(name):
    target = lbt.interop.target_named(name)
    assert all(text and text.isascii() for text in astuple(target.arithmetic))
    assert target.write.__name__.startswith("export_")


def test_each_folder_with_an_export_is_a_target_and_has_an_oracle():
    assert {"c", "cacao", "dao", "iir", "matlab", "pyrtc"} <= set(target_names())
    assert set(target_names()) <= set(ORACLES) | WITHOUT_ORACLE
    assert not set(ORACLES) & WITHOUT_ORACLE


def written_stable(folder, monkeypatch, seeds):
    """Require that no file of these gain files is unstable; return how many were written."""
    monkeypatch.setattr(export_checks, "FRAMES", 100)  # the rehearsal proves nothing here
    written = dict.fromkeys(ORACLES, 0)
    for seed in seeds:
        for name, verdict in judge(folder, seed).items():
            assert verdict is not False, (name, seed)
            written[name] += verdict is not None
    return written


def test_no_target_writes_an_unstable_file(tmp_path, monkeypatch):
    assert all(written_stable(tmp_path, monkeypatch, range(2)).values())


@pytest.mark.study
@pytest.mark.parametrize("chunk", range(100))
def test_no_target_writes_one_of_ten_thousand(tmp_path, monkeypatch, chunk):
    seeds = range(CHUNK * chunk, CHUNK * (chunk + 1))
    assert all(written_stable(tmp_path, monkeypatch, seeds).values())
