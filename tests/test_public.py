"""Every public name: importable, documented, with an example."""

import ast
import doctest
import importlib
import inspect
import pkgutil
import pydoc
import re
from pathlib import Path

import pytest
from support.plants import ROOT
from support.refusals import refused

import lbt_synth as lbt

_STUBS = ROOT.glob("lbt_synth/*/**/*.pyi")
_FOLDERS = (stub.parent.relative_to(ROOT / "lbt_synth") for stub in _STUBS)
ROOMS = sorted({"errors", *(".".join(folder.parts) for folder in _FOLDERS)})
_PAGES = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md"))]


def room(path):
    return importlib.import_module(f"lbt_synth.{path}")


def public_names(path):
    if path == "errors":
        return sorted(name for name in vars(room(path)) if name.endswith("Error"))
    return sorted(n for n in room(path).__all__ if not inspect.ismodule(getattr(room(path), n)))


FACE = [name for name in dir(lbt) if not name.startswith("_")]
NAMES = [f"{path}.{name}" for path in ROOMS for name in public_names(path)]


def public(name):
    path, _, last = name.rpartition(".")
    return getattr(room(path), last)


def listed(stub):
    return {
        alias.asname
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_the_face_has_at_most_forty_four_names_and_no_other():
    assert len(FACE) <= 44
    assert listed(Path(lbt.__file__).with_suffix(".pyi")) == set(FACE)
    for name in FACE:
        thing = getattr(lbt, name)
        if not inspect.ismodule(thing):  # and is one that its room shows
            assert any(thing is public(other) for other in NAMES), name
    refused(lambda: lbt.no_such_name, AttributeError, "no_such_name")
    assert not hasattr(lbt, "__wrapped__")


def test_help_is_a_page_with_every_name():
    text = pydoc.render_doc(lbt, renderer=pydoc.plaintext)
    assert len(text.splitlines()) < 80
    words = set(re.findall(r"\w+", lbt.__doc__))
    assert [name for name in FACE if name not in words and name != "LbtSynthError"] == []


@pytest.mark.parametrize("path", [path for path in ROOMS if path != "errors"])
def test_the_stub_of_a_room_lists_what_is_there(path):
    shown = room(path)
    assert listed(Path(shown.__file__).with_suffix(".pyi")) == set(shown.__all__)
    assert all(getattr(shown, name) is not None for name in shown.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_docstrings(name):
    thing = public(name)
    text = inspect.getdoc(thing)
    assert text
    assert {"K", "k"}.isdisjoint(getattr(thing, "__dataclass_fields__", {}))  # which gain it is
    if inspect.isfunction(thing):
        parameters = inspect.signature(thing).parameters
        for section in ("Parameters", "Examples") if parameters else ("Examples",):
            assert f"{section}\n---" in text, f"{name} has no {section}"
        assert "Returns\n---" in text or "Yields\n---" in text
        for parameter in parameters:
            assert parameter in text, f"{name} does not document {parameter}"


@pytest.mark.parametrize("page", [p for p in _PAGES if ">>> " in (ROOT / p).read_text()])
def test_examples_on_pages_run(page, monkeypatch):
    monkeypatch.chdir(ROOT)
    page = str(ROOT / page)
    results = doctest.testfile(page, module_relative=False, optionflags=doctest.ELLIPSIS)
    assert (results.attempted > 0, results.failed) == (True, 0)


@pytest.mark.parametrize("page", _PAGES)
def test_no_figure_is_left_to_be_filled_in(page):
    """``{{NAME}}`` and a line that is one word in capitals are; LaTeX and JSON close braces, too."""
    text = (ROOT / page).read_text(encoding="utf-8")
    assert re.findall(r".*(?:\{\{|\b[A-Z][A-Z0-9_]*\}\}).*", text) == []
    assert re.findall(r"^[A-Z]{4,}$", text, re.MULTILINE) == []


def test_no_public_name_is_shadowed_by_a_module():
    """Importing every submodule first must not turn a function into its module."""
    for info in pkgutil.walk_packages(lbt.__path__, "lbt_synth."):
        if not info.name.endswith("__main__"):
            importlib.import_module(info.name)
    for name in NAMES:
        assert not inspect.ismodule(public(name)), name
