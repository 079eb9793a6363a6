"""What the page of a study says besides its results."""

from dataclasses import replace

import pytest
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.report.study.sections import short_names, study_info


@pytest.fixture(scope="module")
def study():
    return lbt.studies.load_study(ROOT / "examples" / "study.yaml")


def test_digests_are_of_the_matrices(study):
    first = study_info(study, directory="out")
    other = replace(study, controllers=dict(reversed(study.controllers.items())))
    assert study_info(other, directory="out").digests == first.digests
    assert len(set(first.digests.values())) == 3
    assert first.replay.endswith("study.yaml -o out --row {row}")


def test_short_names_are_different():
    names = ["a.b.c", "d.b.c", "d.e", "e", "f.g"]
    assert list(short_names(names).values()) == ["a.b.c", "d.b.c", "d.e", "e", "g"]
