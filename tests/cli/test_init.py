"""The command init."""

import json

import pytest
from support.commands import refuse_commands, run_done, run_json

import lbt_synth as lbt
from lbt_synth.config.load import example_files, telescope_names
from lbt_synth.config.schema import config_schema


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_telescope_is_written_with_its_schema(here, capsys):
    for telescope in telescope_names():
        run_done(capsys, "init", "--telescope", telescope)
        text = (here / f"{telescope}.yaml").read_text()
        assert text.startswith("# yaml-language-server: $schema=lbt-synth.schema.json\n")
        lbt.load_config(f"{telescope}.yaml")
    assert json.loads((here / "lbt-synth.schema.json").read_text()) == config_schema()


def test_nothing_is_replaced_without_force_and_examples_keep_their_names(here, capsys):
    for _ in range(2):  # the same again replaces nothing
        run_done(capsys, "init")
    (here / "generic.yaml").write_text("mine")
    words = "generic.yaml would be replaced. Give another name by -o, or --force."
    refuse_commands(capsys, [("init", words)])
    assert (here / "generic.yaml").read_text() == "mine"
    data = run_json(capsys, "init", "--force")
    assert data["files"] == ["generic.yaml", "lbt-synth.schema.json"]
    lbt.load_config("generic.yaml")
    run_done(capsys, "init", "--examples")
    assert {file.name for file in (here / "examples").iterdir()} == set(example_files())
    lbt.studies.load_study("examples/study.yaml")
