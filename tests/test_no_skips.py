"""``--no-skips``: what was not checked is no pass."""

import os
import subprocess
import sys

import pytest
from support.plants import ROOT

CASES = {
    "a test that passes": ("def test_it(): pass", 0),
    "a test that is skipped": (
        "import pytest\ndef test_good(): pass\ndef test_it(): pytest.skip('not here')",
        1,
    ),
    "a module that is skipped": ("import pytest\npytest.importorskip('no_such_package')", None),
}


@pytest.mark.parametrize("case", CASES)
def test_a_run_without_skips(tmp_path, case):
    text, expected = CASES[case]
    (tmp_path / "test_case.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "conftest", "--no-skips", "-q", tmp_path],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        capture_output=True,
        text=True,
        check=False,
    )
    if expected is None:
        assert done.returncode != 0
    else:
        assert done.returncode == expected, done.stdout + done.stderr
    assert ("skipped under --no-skips" in done.stdout) == ("skipped" in case)
