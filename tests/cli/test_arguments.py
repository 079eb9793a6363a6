"""The arguments of all commands, their help, and completion."""

from __future__ import annotations

import shutil
import subprocess

import pytest
from support.commands import run


def test_what_can_be_left_out_is_not_called_required(capsys):
    status, _, error = run(capsys, "limits")
    assert (status, "required: config (see" in error) == (2, True)


@pytest.mark.e2e
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_takes_its_script(tmp_path, capsys, shell):
    status, out, error = run(capsys, "init", "--completion", shell)
    assert (status, error) == (0, "")
    assert all(word in out for word in ("tradeoff", "gamma-ratio"))
    script = tmp_path / "script"
    script.write_text(out)
    if found := shutil.which(shell):
        subprocess.run([found, "-n", script], check=True)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("des",), "design"),
        (("design", "--gamma-"), "--gamma-ratio"),
        (("design", "a.yaml", "--method", "kal"), "kalman"),
        (("show", "ga"), "gain.fits"),
        (("init", "--telescope", "ke"), "keck"),
    ],
)
def test_bash_completes(tmp_path, capsys, words, expected):
    (tmp_path / "gain.fits").write_text("")
    (tmp_path / "script").write_text(run(capsys, "init", "--completion", "bash")[1])
    line = " ".join(words)
    code = (
        f"source ./script; COMP_WORDS=(lbt-synth {line}); COMP_CWORD={len(words)}; "
        f"_shtab_lbt_synth lbt-synth {words[-1]} x; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    done = subprocess.run(
        ["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [expected]
