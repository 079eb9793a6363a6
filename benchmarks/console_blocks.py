"""Run the commands of the pages again, and hold what they print against the pages.

    python benchmarks/console_blocks.py docs/tutorial.md            # prints the lines that differ
    python benchmarks/console_blocks.py --write docs/tutorial.md    # and corrects their numbers

Pages share a folder: those whose files other pages need come first.
Lines that have the same words are compared; the numbers may be others. Lines with words that no
command prints are named, and left as they are.
"""

from __future__ import annotations

import argparse
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
    if words[0] == "lbt-synth":
        words = [sys.executable, "-m", "lbt_synth.cli.main", *words[1:]]
    elif words[0] == "python":
        words = [sys.executable, *words[1:]]
    else:
        return []
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    return [line.rstrip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]


def corrected(page: Path, folder: Path) -> list[str]:
    """Return the lines of a page with the numbers of today, and print those that differ."""
    lines = page.read_text().splitlines()
    out, found, inside, command = [], [], False, ""
    for number, line in enumerate(lines, start=1):
        if line.startswith("```"):
            inside = line.startswith("```console")
            found = []
        elif inside and (command or line.startswith("$ ")):
            command += line.removeprefix("$ ")
            if command.endswith("\\"):  # goes on in the next line
                command = command[:-1]
            else:
                found, command = printed(command, folder), ""
        elif inside and line.strip():
            same = [i for i, new in enumerate(found) if shape(new) == shape(line)]
            if same:  # a page may leave lines out
                new = found.pop(min(same, key=lambda i: distance(line, found[i])))
                if distance(line, new) > TOLERANCE:
                    print(f"{page.name}:{number}\n  - {line}\n  + {new}")
                    line = new
            elif found and re.search(r"\w", line):
                print(f"{page.name}:{number} is not printed\n  - {line}")
        out.append(line)
    return out


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
