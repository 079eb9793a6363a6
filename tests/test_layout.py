"""Tests lie as the package does: each file has the module or folder that it tests."""

import pytest
from support.plants import ROOT

TESTS = ROOT / "tests"
PACKAGE = ROOT / "lbt_synth"
WITHOUT_A_ROOM = {
    "test_contracts.py",
    "test_documentation.py",
    "test_layout.py",
    "test_no_skips.py",
    "test_public.py",
    "test_size.py",
    "test_validation.py",
}
FILES = sorted(path.relative_to(TESTS) for path in TESTS.rglob("test_*.py"))


@pytest.mark.parametrize("path", [path for path in FILES if len(path.parts) > 1], ids=str)
def test_a_file_of_tests_has_its_module(path):
    tested = PACKAGE / path.parent / path.stem.removeprefix("test_")
    assert tested.with_suffix(".py").is_file() or (tested / "__init__.py").is_file()


def test_only_what_concerns_the_whole_package_is_in_no_room():
    assert {path.name for path in FILES if len(path.parts) == 1} == WITHOUT_A_ROOM


def test_no_test_lies_in_a_file_that_is_not_collected():
    others = {*TESTS.rglob("*.py")} - {TESTS / path for path in FILES}
    assert {path.name for path in others if path.parent.name != "support"} == {"conftest.py"}
    assert [path for path in others if "\ndef test_" in path.read_text(encoding="utf-8")] == []
