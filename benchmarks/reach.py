"""A pytest plugin: which test reaches which line of some files, and its processor seconds.

`pytest -p reach -n 2` writes what each worker traced to the folder REACH_FOLDER, for the files
that REACH_FILES names, and `load` reads it. The tests of `tests/linear`, with oracles of 60 digits,
are timed and not traced: under a trace they would take most of the hour.
"""

import json
import os
import time
from pathlib import Path

import coverage
import pytest

NOT_TRACED = "tests/linear/"


def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        return
    Path(os.environ["REACH_FOLDER"]).mkdir(exist_ok=True)
    config.processor_seconds = {}
    if files := os.environ.get("REACH_FILES"):
        config.coverage = coverage.Coverage(
            data_file=f"{os.environ['REACH_FOLDER']}/{os.getpid()}.coverage",
            include=files.split(":"),
        )
        config.coverage.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    if not hasattr(item.config, "processor_seconds"):
        return (yield)
    if hasattr(item.config, "coverage"):
        item.config.coverage.switch_context(item.nodeid)
        if item.nodeid.startswith(NOT_TRACED):
            item.config.coverage.stop()
    start = time.process_time()
    result = yield
    if hasattr(item.config, "coverage") and item.nodeid.startswith(NOT_TRACED):
        item.config.coverage.start()
    item.config.processor_seconds[item.nodeid] = round(time.process_time() - start, 2)
    return result


def pytest_unconfigure(config):
    if hasattr(config, "coverage"):
        config.coverage.stop()
        config.coverage.save()
    if hasattr(config, "processor_seconds"):
        path = Path(os.environ["REACH_FOLDER"]) / f"{os.getpid()}.json"
        path.write_text(json.dumps(config.processor_seconds))


def load(folder):
    """Return {file: {line: tests}} and {test: processor seconds}."""
    seconds, lines = {}, {}
    for path in folder.glob("*.json"):
        seconds |= json.loads(path.read_text())
    for path in folder.glob("*.coverage"):
        data = coverage.CoverageData(str(path))
        data.read()
        for file in data.measured_files():
            for line, tests in data.contexts_by_lineno(file).items():
                by_line = lines.setdefault(file, {})
                by_line[line] = by_line.get(line, set()) | {t for t in tests if t}
    return lines, seconds
