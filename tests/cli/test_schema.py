"""The command schema."""

from __future__ import annotations

import json

from support.commands import run

import lbt_synth as lbt


def test_the_schema_is_printed_and_written(tmp_path, capsys):
    schema = lbt.config.config_schema()
    for words in ((), ("--json",)):
        status, out, error = run(capsys, "schema", *words)
        assert (status, error) == (0, "")
        assert json.loads(out) == schema
    file = tmp_path / "s.json"
    assert run(capsys, "schema", "-o", file)[0] == 0
    assert json.loads(file.read_text()) == schema
    assert run(capsys, "schema", "-o", tmp_path / "s.yaml")[0] == 2
