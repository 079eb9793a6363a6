"""Mutants of the files that hold the promises, and how many of them the tests kill.

Mutants are chosen by function and text, in the files of `mutation.json`. Each meets what killed it
last time, then the tests of its file and those that reach its line. `--again` keeps the trace.
"""

import ast
import concurrent.futures
import hashlib
import itertools
import json
import os
import queue
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import reach

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "lbt_synth"
RESULTS = ROOT / "benchmarks" / "mutation.json"
TRACE = ROOT / ".mutation"  # not kept in the repository
MUTANTS = 20  # of each row
SECONDS = 15.0  # of tests of other files that a mutant meets at most
LIMIT_TIME = lambda: resource.setrlimit(resource.RLIMIT_CPU, (150, 150))  # noqa: E731 - seconds
SUITE = ["-q", "-m", "not study and not e2e and not browser", "--doctest-modules"]
WORDS = "Lt GtE Gt LtE Eq NotEq Is IsNot In NotIn Add Sub UAdd USub".split()  # noqa: SIM905
TURNED = {getattr(ast, word): getattr(ast, WORDS[i ^ 1]) for i, word in enumerate(WORDS)}


def run_tests(folder, arguments, **options):
    path = {"PYTHONPATH": f"{folder}:{folder / 'benchmarks'}"}
    command = [sys.executable, "-m", "pytest", *SUITE, *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ | path, check=False, **options)


def mutations(node):
    """Yield the kind of a mutation of one node, and a function that makes it."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in TURNED:
        yield "comparison", lambda: node.ops.__setitem__(0, TURNED[type(node.ops[0])]())
    if type(getattr(node, "op", None)) in TURNED:
        yield "sign", lambda: setattr(node, "op", TURNED[type(node.op)]())
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        number = node.value + 1 if isinstance(node.value, int) or not node.value else 2 * node.value
        yield "number", lambda: setattr(node, "value", number)


def statement_mutants(statement, name):
    """Yield (identity, kind, line, mutation) of a statement without those that it contains."""
    blocks = ("body", "orelse", "finalbody", "handlers")
    skipped = [n for block in blocks for n in getattr(statement, block, [])]
    skipped.append(getattr(statement, "annotation", None))
    pending, text, count = [statement], ast.unparse(statement).splitlines()[0], 0
    while pending:
        node = pending.pop()
        for kind, mutate in mutations(node):
            count += 1
            yield f"{name} {kind} {count} {text}", kind, node.lineno, mutate
        pending += [n for n in ast.iter_child_nodes(node) if n not in skipped]
    target = getattr(getattr(statement, "targets", [None])[0], "id", None)
    again = target and target in [getattr(n, "id", None) for n in ast.walk(statement.value)]
    call = isinstance(getattr(statement, "value", None), ast.Call) and type(statement) is ast.Expr
    if call or again or isinstance(statement, ast.AugAssign | ast.Raise):
        drop = lambda: setattr(statement, "__class__", ast.Pass)  # noqa: E731
        yield f"{name} dropped {text}", "dropped line", statement.lineno, drop


def tree_mutants(tree, name=""):
    for child in ast.iter_child_nodes(tree):
        inside = f"{name}.{child.name}" if getattr(child, "name", None) else name
        if isinstance(child, ast.stmt) and not isinstance(child, ast.Import | ast.ImportFrom):
            yield from statement_mutants(child, inside)
        yield from tree_mutants(child, inside)


def choose(files):
    """Return a row's mutants (identity, file, kind, line): five a kind, the rest by rank."""
    trees = {file: ast.parse((PACKAGE / file).read_text()) for file in files}
    mutants = [(m[0], file, *m[1:3]) for file in files for m in tree_mutants(trees[file])]
    unique = {m[:2]: m for m in reversed(mutants)}.values()
    rows = sorted(unique, key=lambda m: hashlib.sha256(m[0].encode()).hexdigest())
    kinds = sorted({m[2] for m in rows})
    first = [m for k in kinds for m in [m for m in rows if m[2] == k][: MUTANTS // 4]]
    return (first + [m for m in rows if m not in first])[:MUTANTS]


def meet(mutant, copies, lines, seconds, killers):
    """Return what kills a mutant, or None."""
    identity, file, _, line = mutant
    by_line = lines.get(str(PACKAGE / file), {})
    home = f"tests/{Path(file).parent}/test_{Path(file).name}"
    reaching = by_line.get(line) or set().union(*by_line.values())
    order = sorted((t for t in reaching if t in seconds and home not in t), key=seconds.get)
    count = sum(s <= SECONDS for s in itertools.accumulate(seconds[t] for t in order))
    last = [killers[identity]] if "::" in (killers.get(identity) or "") else []
    selections = [last, [home] * (ROOT / home).exists() + order[:count]]
    target = (copy := copies.get()) / "lbt_synth" / file
    tree = ast.parse(original := target.read_text())
    next(m for m in tree_mutants(tree) if m[0] == identity)[3]()
    target.write_text(ast.unparse(ast.fix_missing_locations(tree)))
    try:
        return next((k for tests in selections if tests and (k := killer(copy, tests))), None)
    finally:
        target.write_text(original)
        copies.put(copy)


def killer(copy, tests):
    """Return the first test that fails; None if all pass."""
    (copy / "chosen").write_text("\n".join(tests))
    options = {"capture_output": True, "text": True, "preexec_fn": LIMIT_TIME}
    run = run_tests(copy, ["-x", "-p", "no:cacheprovider", "@chosen"], **options)
    failed = re.search("^(?:FAILED|ERROR) (.+?)(?: - |$)", run.stdout, re.MULTILINE)
    if run.returncode in (0, 4) and "not found" in run.stdout + run.stderr:
        return None  # the test of last time has gone
    return (failed[1] if failed else "no test ended") if run.returncode else None


def main():
    book = json.loads(RESULTS.read_text())
    files = ":".join(str(PACKAGE / file) for row in book["files"].values() for file in row)
    os.environ |= {"REACH_FOLDER": str(TRACE), "REACH_FILES": files}
    if "--again" not in sys.argv:
        shutil.rmtree(TRACE, ignore_errors=True)
        run_tests(ROOT, ["-p", "reach", "-n", "2", "lbt_synth", "tests"])
    lines, seconds = reach.load(TRACE)
    killers, copies = {m["identity"]: m["killed_by"] for m in book["mutants"]}, queue.Queue()
    slowest = sorted(seconds, key=seconds.get)[:-301:-1]
    rows = [(row, mutant) for row, names in book["files"].items() for mutant in choose(names)]
    with tempfile.TemporaryDirectory() as folder, concurrent.futures.ThreadPoolExecutor(2) as pool:
        ignored = shutil.ignore_patterns(".*", "out", "__pycache__", "_build")
        for name in "ab":
            copies.put(Path(shutil.copytree(ROOT, Path(folder) / name, ignore=ignored)))
        results = pool.map(lambda row: meet(row[1], copies, lines, seconds, killers), rows)
        book |= {"mutants": [], "slowest_tests_s": {test: seconds[test] for test in slowest}}
        for (row, mutant), killed_by in zip(rows, results, strict=True):
            book["mutants"] += [{"row": row, "identity": mutant[0], "killed_by": killed_by}]
            RESULTS.write_text(json.dumps(book, indent=1) + "\n")
    for row in book["files"]:
        killed = [m["killed_by"] is not None for m in book["mutants"] if m["row"] == row]
        print(f"| {row} | {sum(killed)} of {len(killed)} |")


if __name__ == "__main__":
    main()
