"""The command help."""

from __future__ import annotations

import json

import pytest
from support.commands import run

from lbt_synth.cli.parser import COMMANDS


@pytest.mark.parametrize("words", [("help", "design"), ("design", "--help")])
def test_the_help_of_a_command_has_two_names(capsys, words):
    status, out, error = run(capsys, *words)
    assert (status, error) == (0, "")
    assert out.startswith("usage: lbt-synth design")
    assert "--gamma-ratio" in out


def test_without_a_command_it_lists_all(capsys):
    status, out, _ = run(capsys, "help")
    assert status == 0
    assert [name for name in COMMANDS if f"\n    {name}" not in out] == []
    assert json.loads(run(capsys, "help", "--json")[1])["help"].strip() == out.strip()


def test_a_mistyped_command_is_suggested(capsys):
    for words in (("help", "desgn"), ("desgn",)):
        status, out, error = run(capsys, *words)
        assert (status, out, error.count("\n")) == (2, "", 1)
        assert "did you mean design?" in error


def test_what_can_be_left_out_is_not_called_required(capsys):
    status, _, error = run(capsys, "robustness")
    assert (status, "required: config (see" in error) == (2, True)
