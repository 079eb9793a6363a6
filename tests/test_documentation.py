"""Pages cite files that are there, and the parts made from the code fail where the code says nothing."""

import ast
import importlib
import inspect
import re
import runpy
import shutil
import tomllib
from types import SimpleNamespace

import pytest
from console_blocks import corrected, distance, shape
from ruamel.yaml import YAML
from support.plants import ROOT

import lbt_synth as lbt

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]
PAGES = sorted(path for path in PAGES if {"generated", "_build"}.isdisjoint(path.parts))
NOTES = [ROOT / "CHANGELOG.md", *ROOT.glob("examples/**/*.md"), *ROOT.glob("tests/**/*.md")]
TESTS = {
    name
    for path in ROOT.glob("tests/**/test_*.py")
    for name in re.findall(r"^def (test_\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE)
}
ADDRESS = re.compile(r"\s*(?:[-*] )?(?:!?\[[^\]]*\]\(\S+\)|\S{90,})[.,;:]?")
NOT_ENGLISH = re.compile(r"(?i)\b(?:anew|told|answers? to a step|one a (?:mode|frame))\b")


def prose(text):
    """Return the lines of a page outside code, tables, headings and addresses that stand alone."""
    text = re.sub(r"^ *\$\$.+\$\$ *$", "", text, flags=re.MULTILINE)
    text = re.sub(
        r"^ *(`{3,}|~{3,}|\$\$)[^\n]*\n.*?^ *\1 *$", "", text, flags=re.MULTILINE | re.DOTALL
    )
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(("#", "|"))]
    return [line for line in lines if not ADDRESS.fullmatch(line)]


@pytest.mark.parametrize("page", [*PAGES, *NOTES], ids=lambda page: str(page.relative_to(ROOT)))
def test_prose_is_plain_and_no_line_is_longer_than_100(page):
    text = page.read_text(encoding="utf-8")
    lines = prose(text)
    assert len(text.splitlines()) <= 120 or "decisions" not in page.parts  # what holds today
    assert [line for line in lines if len(line) > 100] == []
    assert NOT_ENGLISH.findall(" ".join(lines)) == []


def test_the_citation_is_of_this_version_and_goes_into_the_source_archive():
    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert (citation["version"], citation["references"][0]["year"]) == (lbt.__version__, 2008)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "CITATION.cff" in project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]


@pytest.fixture(scope="module")
def house():
    return SimpleNamespace(**runpy.run_path(ROOT / "docs" / "house.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_tests_that_a_page_cites_are_there(page):
    text = page.read_text(encoding="utf-8")
    folders = "tests|benchmarks|docs|examples|lbt_synth"
    cited = re.findall(rf"\b(?:{folders})/[\w/]+\.(?:py|md|yaml|png)\b", text)
    assert [path for path in cited if not (ROOT / path).exists()] == []
    assert set(re.findall(r"`(test_\w+)`", text)) <= TESTS


def test_every_module_has_a_sentence_and_every_room_a_table(house):
    text = house.architecture()
    modules = [path for path in (ROOT / "lbt_synth").rglob("*.py") if path.name[:2] != "__"]
    rows = re.findall(r"^\| `([\w.]+)` \| .+\. \|$", text, re.MULTILINE)
    for path in modules:
        name = ".".join(path.relative_to(ROOT / "lbt_synth").with_suffix("").parts)
        assert name in rows or f"### {name}" in text
    assert re.findall(r"^### (\w+)$", text, re.MULTILINE) == house.rooms()


@pytest.mark.parametrize("text", ["", '"""TODO"""\n', '"""No full stop"""\n', "import os\n"])
def test_a_module_without_a_sentence_fails_the_build(house, tmp_path, text):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for room in house.rooms():
        (tmp_path / "lbt_synth" / room).mkdir(parents=True)
        (tmp_path / "lbt_synth" / room / "__init__.py").write_text('"""A room for a test."""\n')
    assert "### linear" in house.architecture(tmp_path)
    (tmp_path / "lbt_synth" / "linear" / "new.py").write_text(text)
    with pytest.raises(ValueError, match=r"new\.py: the docstring must begin with a sentence"):
        house.architecture(tmp_path)


def test_the_reference_has_the_names_of_the_stubs(house):
    pages, index = house.reference(), (ROOT / "docs" / "api" / "index.md").read_text()
    rooms = re.findall(r"^rooms/(\w+)$", index, re.MULTILINE)
    assert set(rooms) == {room.replace(".", "_") for room in pages}
    for room, name in (("linear", "solve_dare"), ("errors", "InfeasibleError")):
        assert f"\n   {name}\n" in pages[room]


SCRIPTS = sorted([*ROOT.glob("benchmarks/*.py"), *ROOT.glob("examples/**/*.py")])


def module_path(node):
    """``lbt.models.ARModel`` as ["models", "ARModel"]; None if it does not begin with lbt."""
    names = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return names[::-1] if isinstance(node, ast.Name) and node.id == "lbt" else None


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_names_that_a_script_uses_are_there(script):
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lbt_synth"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
        elif path := module_path(node):
            thing = lbt
            while path and inspect.ismodule(thing):
                thing = getattr(thing, path.pop(0))


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["tutorial", "diagnose"])
def test_commands_print_what_the_page_shows(name, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "out").mkdir()
    page = ROOT / "docs" / f"{name}.md"
    shown, today = page.read_text().splitlines(), corrected(page, tmp_path)
    assert [*map(shape, today)] == [*map(shape, shown)]
    assert max(map(distance, today, shown)) < 0.01
