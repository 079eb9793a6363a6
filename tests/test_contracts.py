"""The contracts of imports hold for modules that are not yet written."""

import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from support.plants import ROOT

# a module that somebody may write tomorrow, what it imports, and the contract that it breaks
FORBIDDEN = {
    "design/new_method.py": ("cvxpy", "Only linear.lmi imports cvxpy"),
    "interop/new_program.py": ("specula", "Only interop.specula.optics imports specula"),
    "files/telemetry/new_format.py": ("aotpy", "Only files.telemetry.aot imports aotpy"),
    "files/telemetry/new_archive.py": ("h5py", "Only storage.array_file imports h5py"),
    "studies/study/new_pool.py": ("distributed", "Only storage.executors imports distributed"),
    "report/page/new_chart.py": ("bokeh", "Only report.explore imports bokeh"),
    "report/page/new_sheet.py": ("weasyprint", "Only report.page.html imports weasyprint"),
    "report/new_page.py": ("jinja2", "Only report.page.html imports jinja2"),
    "loop/new_figure.py": ("matplotlib", "Only report imports matplotlib"),
    "linear/new_system.py": ("control", "Only linear.state_space imports control"),
    "interop/new_rtc.py": ("pyrtc", "Only interop.pyrtc imports pyrtc"),
    "linear/new_oracle.py": ("slycot", "Nothing else imports a GPL package"),
    "linear/new_plant.py": ("lbt_synth.models", "Rooms import only downwards"),
}

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CONTRACTS = {contract["name"] for contract in PROJECT["tool"]["importlinter"]["contracts"]}


def broken_contracts(folder):
    """Exit status, names of the contracts that a copy of the package breaks, and the text."""
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", code, "--config", str(ROOT / "pyproject.toml"), "--no-cache"]
    environment = {**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"}
    options = {"env": environment, "capture_output": True, "text": True}
    done = subprocess.run(command, cwd=folder, check=False, **options)
    said = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)  # older versions colour what is no terminal
    broken = set(re.findall(r"^(.*) BROKEN\b", said, re.MULTILINE))
    return done.returncode, broken, said


@pytest.fixture
def package(tmp_path):
    ignored = shutil.ignore_patterns("__pycache__")
    return shutil.copytree(ROOT / "lbt_synth", tmp_path / "lbt_synth", ignore=ignored)


def test_each_contract_holds_for_a_module_that_is_not_yet_written(package):
    status, broken, text = broken_contracts(package.parent)
    assert (status, broken) == (0, set()), text
    for path, (module, _) in FORBIDDEN.items():
        (package / path).write_text(f'"""New."""\n\nimport {module}\n')
    status, broken, text = broken_contracts(package.parent)
    assert status == 1
    assert broken == CONTRACTS, text


def test_a_room_that_is_not_in_the_order_is_refused(package):
    (package / "new_room").mkdir()
    (package / "new_room" / "__init__.py").write_text('"""New."""\n')
    status, _, text = broken_contracts(package.parent)
    assert status == 1
    assert "- lbt_synth.new_room" in text
