"""The targets of an export."""

from __future__ import annotations

from dataclasses import astuple

import pytest

import lbt_synth as lbt
from lbt_synth.interop.target import target_names


@pytest.mark.parametrize("name", target_names())
def test_a_target_says_how_it_computes(name):
    target = lbt.interop.target_named(name)
    assert all(text and text.isascii() for text in astuple(target.arithmetic))
    assert target.write.__name__.startswith("export_")


def test_each_folder_with_an_export_is_a_target():
    assert target_names() == ("c", "dao", "iir", "matlab", "pyrtc")
