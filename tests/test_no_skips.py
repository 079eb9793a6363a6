"""``--no-skips``: what was not checked is no pass."""

import os
import subprocess
import sys

import pytest
from support.plants import ROOT

SKIPPED = "import pytest\ndef test_good(): pass\ndef test_it(): pytest.skip('not here')"


@pytest.mark.parametrize(
    ("text", "status", "words"),
    [("def test_it(): pass", 0, "1 passed"), (SKIPPED, 1, "2 skipped under --no-skips")],
    ids=["all are made", "a test and a module are skipped"],
)
def test_a_run_without_skips(tmp_path, text, status, words):
    (tmp_path / "test_case.py").write_text(text)
    if status:
        (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('no_such')")
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    options = {"env": os.environ | {"PYTHONPATH": paths}, "capture_output": True, "text": True}
    command = [sys.executable, "-m", "pytest", "-p", "conftest", "--no-skips", "-q", tmp_path]
    done = subprocess.run(command, cwd=tmp_path, check=False, **options)
    assert done.returncode == status, done.stdout + done.stderr
    assert words in done.stdout
