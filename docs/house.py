"""What the documentation says of the code, read from the code.

The architecture page takes the order of the rooms from the contract in ``pyproject.toml``
and the first sentence of each module's docstring; the reference has one page per room,
with the names of its stub.
"""

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def rooms(pyproject: Path = ROOT / "pyproject.toml") -> list[str]:
    """Return the rooms of the layers contract, the topmost first."""
    contracts = tomllib.loads(pyproject.read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    return list(layers)


def first_sentence(module: Path) -> str:
    """Return the first sentence of a module's docstring.

    Raises
    ------
    ValueError
        If the module has no docstring, or its first line does not end a sentence.
    """
    lines = (ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or "").split("\n\n")
    sentence = " ".join(lines[0].split())
    sentence = re.split(r"(?<=\.)\s", sentence)[0]
    if not re.fullmatch(r"[^\s].{9,}\.", sentence):
        raise ValueError(
            f"{module}: the docstring must begin with a sentence that says what the module holds; "
            f"got {sentence!r}."
        )
    return sentence


def module_table(package: Path, prefix: str) -> list[str]:
    """Return the rows of a room's table: module and sentence."""
    rows = []
    for file in sorted(package.rglob("*.py")):
        parts = file.relative_to(package).with_suffix("").parts
        if parts == ("__init__",):
            continue
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        rows.append(f"| `{prefix}.{name}` | {first_sentence(file)} |")
    return rows


def architecture(root: Path = ROOT) -> str:
    """Return the part of the architecture page that is made from the code."""
    package = root / "lbt_synth"
    order = rooms(root / "pyproject.toml")
    out = ["```text", *order, "```", ""]
    for room in order:
        folder = package / room
        if folder.is_dir():
            out += [f"### {room}", "", first_sentence(folder / "__init__.py"), ""]
            out += ["| module | what it holds |", "|---|---|", *module_table(folder, room), ""]
        else:
            out += [f"### {room}", "", first_sentence(package / f"{room}.py"), ""]
    return "\n".join(out)


def public_names(room: Path) -> list[str]:
    """Return the public names of a room: functions first, then classes."""
    if room.with_suffix(".py").exists():  # errors: a module
        found = [
            node.name
            for node in ast.parse(room.with_suffix(".py").read_text()).body
            if isinstance(node, ast.ClassDef)
        ]
    else:
        found = [
            alias.name
            for node in ast.parse((room / "__init__.pyi").read_text()).body
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        ]
    return sorted(found, key=lambda name: (name[0].isupper(), name.lower()))


def reference(root: Path = ROOT) -> dict[str, str]:
    """Return the pages of the reference by the dotted names of the rooms."""
    package = root / "lbt_synth"
    stubs = [stub.parent.relative_to(package) for stub in sorted(package.rglob("__init__.pyi"))]
    found = [".".join(path.parts) for path in stubs if path.parts] + ["errors"]
    order = rooms(root / "pyproject.toml")
    found.sort(key=lambda room: (-order.index(room.split(".")[0]), room))
    return {
        room: "\n".join(
            [
                f"# lbt_synth.{room}",
                "",
                "```{eval-rst}",
                f".. automodule:: lbt_synth.{room}",
                "   :no-members:",
                "",
                f".. currentmodule:: lbt_synth.{room}",
                "",
                ".. autosummary::",
                "   :toctree: ../generated",
                "",
                *(f"   {name}" for name in public_names(package / room.replace(".", "/"))),
                "```",
                "",
            ]
        )
        for room in found
    }


def write(folder: Path) -> None:
    """Write the generated pages below the folder of the reference."""
    (folder / "generated").mkdir(exist_ok=True)
    (folder / "generated" / "modules.md").write_text(architecture(), encoding="utf-8")
    (folder / "rooms").mkdir(exist_ok=True)
    for room, text in reference().items():
        (folder / "rooms" / f"{room.replace('.', '_')}.md").write_text(text, encoding="utf-8")
