"""Short names of parameters."""

from __future__ import annotations

from lbt_synth.studies.study.summary import short_names


def test_short_names_are_different():
    names = ["a.b.c", "d.b.c", "d.e", "e", "f.g"]
    assert list(short_names(names).values()) == ["a.b.c", "d.b.c", "d.e", "e", "g"]
