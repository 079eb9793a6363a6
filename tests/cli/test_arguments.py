"""The arguments of all commands, their help, and completion."""

from __future__ import annotations

import shutil
import subprocess

import pytest
import shtab
from support.commands import run_done

from lbt_synth.cli.arguments import COMMANDS, build_parser


def test_the_help_lists_every_command_once_in_groups(capsys):
    text = run_done(capsys, "--help")
    groups = [line for line in text.splitlines() if line[:1].isalpha() and ": " in line]
    assert [group.partition(":")[0] for group in groups[1:-1]] == [
        *("start", "design", "look", "prove", "records", "at the telescope"),
        "the paper and the simulator",
    ]
    names = [line.split()[0] for line in text.splitlines() if line[:2] == "  " and line[2] != " "]
    assert [name for name in names if name in COMMANDS] == list(COMMANDS)


def test_help_says_the_defaults(capsys):
    for command, words in (
        ("tradeoff", "the Kalman filter's (default 9)"),
        ("identify", "counts as turbulence [Hz] (default 3)"),
    ):
        assert words in " ".join(run_done(capsys, command, "--help").split())


def script_of(shell):
    """The script with which a shell completes commands."""
    return shtab.complete(build_parser(), shell=shell)


@pytest.mark.e2e
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_takes_its_script(tmp_path, shell):
    script = tmp_path / "script"
    script.write_text(script_of(shell))
    assert all(word in script.read_text() for word in ("tradeoff", "gamma-ratio"))
    if found := shutil.which(shell):
        subprocess.run([found, "-n", script], check=True)


@pytest.mark.e2e
def test_bash_completes(tmp_path):
    (tmp_path / "gain.fits").write_text("")
    (tmp_path / "script").write_text(script_of("bash"))
    for line, expected in (
        ("des", "design"),
        ("design --gamma-", "--gamma-ratio"),
        ("design a.yaml --method kal", "kalman"),
        ("show ga", "gain.fits"),
        ("init --telescope ke", "keck"),
    ):
        *_, last = words = line.split()
        code = (
            f"source ./script; COMP_WORDS=(lbt-synth {line}); COMP_CWORD={len(words)}; "
            f"_shtab_lbt_synth lbt-synth {last} x; printf '%s\\n' \"${{COMPREPLY[@]}}\""
        )
        options = {"cwd": tmp_path, "capture_output": True, "text": True, "check": True}
        assert subprocess.run(["bash", "-c", code], **options).stdout.split() == [expected]
