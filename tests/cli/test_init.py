"""The command init."""

import json

import pytest
from support.commands import run

import lbt_synth as lbt
from lbt_synth.config.load import example_files, telescope_names
from lbt_synth.config.schema import config_schema


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("telescope", telescope_names())
def test_a_telescope_is_written_with_its_schema(here, capsys, telescope):
    status, out, error = run(capsys, "init", "--telescope", telescope)
    assert (status, error) == (0, "")
    assert f"Next, put in your own numbers; then lbt-synth design {telescope}.yaml" in out
    text = (here / f"{telescope}.yaml").read_text()
    assert text.startswith("# yaml-language-server: $schema=lbt-synth.schema.json\n")
    assert json.loads((here / "lbt-synth.schema.json").read_text()) == config_schema()
    lbt.load_config(f"{telescope}.yaml")


def test_nothing_is_replaced_without_force(here, capsys):
    assert run(capsys, "init")[0] == 0
    assert run(capsys, "init")[0] == 0  # the same again replaces nothing
    (here / "generic.yaml").write_text("mine")
    status, _, error = run(capsys, "init")
    assert status == 2
    assert "generic.yaml would be replaced. Give another name by -o, or --force." in error
    assert (here / "generic.yaml").read_text() == "mine"
    status, out, _ = run(capsys, "init", "--force", "--json")
    assert json.loads(out)["files"] == ["generic.yaml", "lbt-synth.schema.json"]
    lbt.load_config("generic.yaml")


def test_the_examples_are_written_under_their_names(here, capsys):
    assert run(capsys, "init", "--examples")[0] == 0
    assert {file.name for file in (here / "examples").iterdir()} == set(example_files())
    lbt.studies.load_study("examples/study.yaml")
