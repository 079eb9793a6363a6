"""``--no-skips``: what was not checked is no pass."""

import os
import subprocess
import sys

import pytest
from support.plants import ROOT

CASES = {  # a file, its exit status, and what is skipped
    "all are made": ("def test_it(): pass", 0, None),
    "a test and a module are skipped": (
        "import pytest\ndef test_good(): pass\ndef test_it(): pytest.skip('not here')",
        1,
        "2 skipped under --no-skips",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_run_without_skips(tmp_path, case):
    text, status, words = CASES[case]
    (tmp_path / "test_case.py").write_text(text)
    if status:
        (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('no_such')")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "conftest", "--no-skips", "-q", tmp_path],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert (words or "1 passed") in done.stdout
