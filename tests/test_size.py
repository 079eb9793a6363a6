"""The size of the house: it may shrink, and a room that grows by 5 % says so here.

The numbers are what is there. Who makes a room smaller writes the new number.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from support.plants import ROOT

PACKAGE = ROOT / "lbt_synth"
GENERATED = {"_build", "generated", "rooms", "gallery"}
GROWTH = 1.05  # of a number, before it is too much
LINES = {
    "cli": 3200,
    "config": 1611,
    "design": 6006,
    "files": 1273,
    "identification": 8959,
    "interop": 3694,
    "linear": 4697,
    "loop": 3975,
    "methods": 802,
    "models": 3781,
    "report": 3534,
    "storage": 1163,
    "studies": 3171,
    "errors, validation": 564,
}
COUNTS = {
    "files of the package": 205,
    "public names": 147,
    "tuned constants": 504,
    "lines of tests": 24862,
    "lines of benchmarks": 3998,
    "words of docs": 60221,
}


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def _room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else "errors, validation"


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _constants(path: Path) -> int:
    """Return how many numbers a module gives names to."""
    count = 0
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            numbers = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            count += len(numbers) if all(map(_is_number, numbers)) else 0
    return count


def _public_names(path: Path) -> int:
    """Return how many names a stub shows."""
    return len(set(re.findall(r"import \w+ as (\w+)", path.read_text(encoding="utf-8"))))


def _pages() -> Iterator[Path]:
    yield ROOT / "README.md"
    for path in (ROOT / "docs").rglob("*.md"):
        if GENERATED.isdisjoint(path.relative_to(ROOT).parts):
            yield path


def _complaint(name: str, size: int, limit: int, sizes: dict[Path, int]) -> str:
    largest = sorted(sizes, key=lambda path: -sizes[path])[:5]
    rows = "\n".join(f"  {sizes[path]:6} {path.relative_to(ROOT)}" for path in largest)
    return (
        f"{name}: {size}, {100 * (size / limit - 1):.0f} % more than the {limit} it had. Is there "
        f"a second way to do what another file does, or a file with one reader? Look first at\n"
        f"{rows}"
    )


def _complaints(sizes: dict[str, dict[Path, int]], limits: dict[str, int]) -> list[str]:
    totals = {name: sum(sizes[name].values()) for name in limits}
    return [
        _complaint(name, totals[name], limit, sizes[name])
        for name, limit in limits.items()
        if totals[name] > GROWTH * limit
    ]


def test_no_room_grows():
    modules = [*PACKAGE.rglob("*.py")]
    rooms = {room: {p: _lines(p) for p in modules if _room(p) == room} for room in LINES}
    assert sum(map(len, rooms.values())) == len(modules), "a room has no number here"
    complaints = _complaints(rooms, LINES)
    assert not complaints, "\n".join(complaints)


def test_no_count_grows():
    modules = [*PACKAGE.rglob("*.py")]
    sizes = {
        "files of the package": dict.fromkeys(modules, 1),
        "public names": {path: _public_names(path) for path in PACKAGE.rglob("__init__.pyi")},
        "tuned constants": {path: _constants(path) for path in modules},
        "lines of tests": {path: _lines(path) for path in (ROOT / "tests").rglob("*.py")},
        "lines of benchmarks": {path: _lines(path) for path in (ROOT / "benchmarks").rglob("*.py")},
        "words of docs": {p: len(p.read_text(encoding="utf-8").split()) for p in _pages()},
    }
    complaints = _complaints(sizes, COUNTS)
    assert not complaints, "\n".join(complaints)


def test_a_number_that_is_exceeded_names_the_largest_file():
    small, large = ROOT / "small.py", ROOT / "large.py"
    sizes = {"room": {small: 40, large: 66}}
    assert _complaints(sizes, {"room": 101}) == []
    (complaint,) = _complaints(sizes, {"room": 100})
    assert complaint.startswith("room: 106, 6 % more than the 100")
    assert complaint.index("large.py") < complaint.index("small.py")
