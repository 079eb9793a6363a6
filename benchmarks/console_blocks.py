"""Run the commands of the pages again, and hold what they print against the pages.

    python benchmarks/console_blocks.py docs/tutorial.md            # prints the lines that differ
    python benchmarks/console_blocks.py --write docs/tutorial.md    # and corrects them

Pages share a folder: those whose files other pages need come first.
A block whose lines have words that are printed gets the numbers of today; one with words that no
command prints gets all that lbt-synth prints.
"""

from __future__ import annotations

import argparse
import difflib
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROUNDING, TOLERANCE = 1e-9, 2e-6
NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def shape(line: str) -> str:
    """Return a line without its numbers and blanks."""
    return re.sub(r"\s+", " ", NUMBER.sub("#", line)).strip()


def distance(one: str, other: str) -> float:
    """Return the largest relative difference between the numbers of two lines."""
    pairs = zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)
    numbers = [(float(a), float(b)) for a, b in pairs]
    return max((abs(a - b) / max(abs(a), abs(b), ROUNDING) for a, b in numbers), default=0.0)


def printed(command: str, folder: Path) -> list[str]:
    """Run a command of a page, and return the lines that it prints."""
    words = shlex.split(command)
    if not words:
        return []
    if words[0] == "lbt-synth":
        words = [sys.executable, "-m", "lbt_synth.cli.main", *words[1:]]
    elif words[0] == "python":
        words = [sys.executable, *words[1:]]
    else:
        return []
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    text = (done.stdout + done.stderr).strip("\n")
    return [line.rstrip() for line in text.splitlines()]


def renewed(command: str, shown: list[str], folder: Path) -> list[str]:
    """Return what a page shows of a command, with the numbers or all the lines of today.

    A block whose words are all printed keeps its lines, and may leave some out.
    """
    found = printed(command, folder)
    if not found or not shown:
        return shown
    out, pool = [], list(found)
    for line in shown:
        same = [i for i, new in enumerate(pool) if shape(new) == shape(line)]
        if not same and re.search(r"\w", line):
            return found if command.startswith("lbt-synth") else shown
        new = pool.pop(min(same, key=lambda i: distance(line, pool[i]))) if same else line
        out.append(new if distance(line, new) > TOLERANCE else line)
    return out


def corrected(page: Path, folder: Path) -> list[str]:
    """Return the lines of a page with what is printed today, and print those that differ."""
    lines = page.read_text().splitlines()
    out, shown, inside, command = [], [], False, ""
    for line in [*lines, "```"]:
        begins = inside and line.startswith("$ ")
        if inside and (begins or line.startswith("```")) and not command.endswith("\\"):
            today = renewed(command, shown, folder)
            if today != shown:
                changes = difflib.unified_diff(shown, today, page.name, command, lineterm="", n=0)
                print(*changes, sep="\n")
            out += today
            shown, command = [], ""
        if line.startswith("```"):
            inside = line.startswith("```console")
        elif begins or command.endswith("\\"):
            command = command.removesuffix("\\") + line.removeprefix("$ ")
        elif inside:
            shown.append(line)
            continue
        out.append(line)
    return out[:-1]


def main() -> None:
    """Print what differs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", action="store_true")
    parser.add_argument("pages", nargs="+", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "examples").symlink_to(ROOT / "examples")
        (folder / "out").mkdir()
        for page in arguments.pages:
            lines = corrected(page, folder)
            if arguments.write:
                page.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
