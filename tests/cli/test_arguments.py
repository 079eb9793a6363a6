"""The arguments of all commands, their help, and completion."""

import shutil
import subprocess

import pytest
import shtab
from support.commands import run_done

from lbt_synth.cli.arguments import COMMANDS, build_parser


def test_the_help_lists_every_command_once_in_groups_and_says_the_defaults(capsys):
    text = run_done(capsys, "--help")
    groups = [line for line in text.splitlines() if line[:1].isalpha() and ": " in line]
    assert [group.partition(":")[0] for group in groups[1:-1]] == [
        *("start", "design", "look", "prove", "records", "at the telescope"),
        "the paper and the simulator",
    ]
    names = [line.split()[0] for line in text.splitlines() if line[:2] == "  " and line[2] != " "]
    assert [name for name in names if name in COMMANDS] == list(COMMANDS)
    for command, words in (
        ("tradeoff", "the Kalman filter's (default 9)"),
        ("identify", "counts as turbulence [Hz] (default 3)"),
    ):
        assert words in " ".join(run_done(capsys, command, "--help").split())


@pytest.mark.e2e
def test_shells_take_their_scripts_and_bash_completes(tmp_path):
    (tmp_path / "gain.fits").write_text("")
    for shell in ("zsh", "bash"):
        (tmp_path / "script").write_text(shtab.complete(build_parser(), shell=shell))
        assert "gamma-ratio" in (tmp_path / "script").read_text()
        if found := shutil.which(shell):
            subprocess.run([found, "-n", tmp_path / "script"], check=True)
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
