"""What the architecture page says of the code, read from the code.

The order of the rooms is that of the contract in ``pyproject.toml``; the table of
modules holds the first sentence of each module's docstring.
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


def page(root: Path = ROOT) -> str:
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
