"""Resumable runs lose nothing and do nothing twice, whoever is killed."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.processes import alive, wait_for

from lbt_synth.errors import NumericalError, OutputError, ProblemError, UnstableLoopError
from lbt_synth.storage import run_cases

CASES = {f"case-{i}": {"x": i} for i in range(6)}


def square(case):
    return {"square": case["x"] ** 2}


def fails_on_two(case):
    if case["x"] == 2:
        raise ProblemError("two is too many")
    return square(case)


EXPECTED = {name: {"square": case["x"] ** 2} for name, case in CASES.items()}


class Counted:
    def __init__(self):
        self.done = []

    def __call__(self, case):
        self.done.append(case["x"])
        return square(case)


def test_only_what_is_missing_is_run(tmp_path):
    first, second = Counted(), Counted()
    run_cases(first, {k: CASES[k] for k in ("case-1", "case-3")}, tmp_path)
    assert run_cases(second, CASES, tmp_path) == EXPECTED
    assert sorted(first.done) == [1, 3]
    assert sorted(second.done) == [0, 2, 4, 5]


@settings(max_examples=20, deadline=None)
@given(present=st.sets(st.sampled_from(sorted(CASES))))
def test_the_results_do_not_depend_on_what_was_there(tmp_path_factory, present):
    folder = tmp_path_factory.mktemp("results")
    run_cases(square, {k: CASES[k] for k in present}, folder)
    counted, seen = Counted(), []
    assert list(run_cases(counted, CASES, folder, progress=seen.append).items()) == list(
        EXPECTED.items()
    )
    assert len(counted.done) == len(CASES) - len(present)
    assert sum(seen) == len(CASES)


def test_processes_and_any_executor_give_the_same(tmp_path):
    for name in ("serial", "processes", "threads"):
        (tmp_path / name).mkdir()
    run_cases(square, CASES, tmp_path / "serial")
    run_cases(square, CASES, tmp_path / "processes", jobs=2)
    with ThreadPoolExecutor(3) as pool:
        run_cases(square, CASES, tmp_path / "threads", executor=pool)
        assert pool.submit(int, "7").result() == 7  # left open
    texts = [
        sorted(path.read_text() for path in (tmp_path / name).glob("*.json"))
        for name in ("serial", "processes", "threads")
    ]
    assert texts[0] == texts[1] == texts[2]
    assert len(texts[0]) == 6


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_case_that_fails_takes_no_other_with_it(tmp_path, jobs):
    with pytest.raises(ProblemError, match="two is too many"):
        run_cases(fails_on_two, CASES, tmp_path, jobs=jobs)
    kept = {path.stem for path in tmp_path.glob("*.json")}
    assert "case-2" not in kept
    assert {"case-0", "case-1"} <= kept
    counted = Counted()
    assert run_cases(counted, CASES, tmp_path) == EXPECTED
    assert len(counted.done) == len(CASES) - len(kept)


def test_results_of_other_settings_are_not_mixed_in(tmp_path):
    run_cases(square, CASES, tmp_path)
    with pytest.raises(OutputError, match="result of other settings"):
        run_cases(square, {"case-0": {"x": 100}}, tmp_path)
    assert json.loads((tmp_path / "case-0.json").read_text())["result"] == {"square": 0}


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"asked": 1}', '{"asked": 1, "digest": 2, "result": 3}']
)
def test_a_file_that_is_no_result_is_named(tmp_path, text):
    (tmp_path / "case-0.json").write_text(text)
    with pytest.raises(OutputError, match="not the result of a run"):
        run_cases(square, CASES, tmp_path)


def test_a_result_that_was_changed_is_not_believed(tmp_path):
    run_cases(square, CASES, tmp_path)
    file = tmp_path / "case-3.json"
    file.write_text(file.read_text().replace('"square": 9', '"square": 10'))
    with pytest.raises(OutputError, match="changed after it was written"):
        run_cases(square, CASES, tmp_path)
    file.unlink()
    assert run_cases(square, CASES, tmp_path) == EXPECTED


@pytest.mark.parametrize("returned", [3, None, "abc", [1, 2]])
def test_a_result_has_to_be_a_mapping(tmp_path, returned):
    with pytest.raises(ProblemError, match="result of a must fit"):
        run_cases(lambda _: returned, {"a": {"x": 1}}, tmp_path)
    assert not list(tmp_path.glob("*.json"))


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a b", 3])
def test_names_are_names_of_files(tmp_path, name):
    with pytest.raises(ProblemError, match="name of a case"):
        run_cases(square, {name: {"x": 1}}, tmp_path)


def test_cases_and_results_have_to_fit_into_json(tmp_path):
    with pytest.raises(ProblemError, match="must fit into JSON"):
        run_cases(square, {"a": {"x": float("nan")}}, tmp_path)
    with pytest.raises(ProblemError, match="result of a must fit"):
        run_cases(lambda _: {"x": float("inf")}, {"a": {"x": 1}}, tmp_path)
    assert not list(tmp_path.glob("*.json"))


@dataclass(frozen=True)
class Loop:
    gains: np.ndarray


def test_a_case_may_hold_arrays_and_dataclasses(tmp_path):
    def case(*gains):
        return {"a": {"loop": Loop(gains=np.array(gains))}}

    def total(one):
        return {"total": float(one["loop"].gains.sum())}

    assert run_cases(total, case(1.0, 2.0), tmp_path) == {"a": {"total": 3.0}}
    kept = json.loads((tmp_path / "a.json").read_text())["case"]
    assert kept == {"loop": {"gains": [1.0, 2.0]}}
    with pytest.raises(OutputError, match="result of other settings"):
        run_cases(total, case(1.0, 2.5), tmp_path)
    with pytest.raises(ProblemError, match="case b must fit into JSON"):
        run_cases(total, {"b": {"loop": object()}}, tmp_path)


def test_no_directory(tmp_path):
    with pytest.raises(OutputError, match="cannot write into"):
        run_cases(square, CASES, tmp_path / "nowhere")


SCRIPT = """
    import os, sys, time, pathlib
    from lbt_synth.storage import run_cases

    def slow(case):
        with pathlib.Path(os.environ["RUNS"]).open("a") as stream:   # one line a run that ended
            time.sleep(0.3)
            stream.write(f"{case['x']} {os.getpid()}\\n")
        return {"x": case["x"]}

    if __name__ == "__main__":
        cases = {f"c{i}": {"x": i} for i in range(8)}
        print(sorted(run_cases(slow, cases, sys.argv[1], jobs=int(sys.argv[2]))), flush=True)
"""


def start(tmp_path, jobs):
    script = tmp_path / "resumable_script.py"
    script.write_text(textwrap.dedent(SCRIPT))
    (tmp_path / "out").mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "out"), str(jobs)],
        env={**os.environ, "RUNS": str(tmp_path / "runs.txt")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job ignores interrupts, and so would what it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def results(tmp_path):
    return sorted(path.stem for path in (tmp_path / "out").glob("*.json"))


@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_it_goes_on_where_it_was(tmp_path, jobs):
    first = start(tmp_path, jobs)
    wait_for(lambda: len(results(tmp_path)) >= 2)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    kept = results(tmp_path)
    assert 2 <= len(kept) < 8
    assert not list((tmp_path / "out").glob("*.tmp"))
    workers = {int(line.split()[1]) for line in (tmp_path / "runs.txt").read_text().splitlines()}
    wait_for(lambda: not any(alive(pid) for pid in workers))  # none is left behind
    (tmp_path / "runs.txt").write_text("")
    second = start(tmp_path, jobs)
    out, errors = second.communicate(timeout=60)
    assert second.returncode == 0, errors
    assert out.strip() == str([f"c{i}" for i in range(8)])
    again = [line.split()[0] for line in (tmp_path / "runs.txt").read_text().splitlines()]
    assert sorted(f"c{x}" for x in again) == sorted(set(results(tmp_path)) - set(kept))


def test_two_runs_in_one_directory_are_refused(tmp_path):
    first = start(tmp_path, 1)
    wait_for(lambda: len(results(tmp_path)) >= 1)
    with pytest.raises(OutputError, match="another computation"):
        run_cases(square, CASES, tmp_path / "out")
    first.kill()
    first.communicate()


def test_an_interrupt_ends_the_processes_at_once(tmp_path):
    first = start(tmp_path, 2)
    wait_for(lambda: len(results(tmp_path)) >= 2)
    first.send_signal(signal.SIGINT)
    _, errors = first.communicate(timeout=10)
    assert first.returncode != 0
    assert errors.count("KeyboardInterrupt") == 1  # the parent's own
    workers = {int(line.split()[1]) for line in (tmp_path / "runs.txt").read_text().splitlines()}
    wait_for(lambda: not any(alive(pid) for pid in workers), seconds=5)


def dies(case):
    if case["x"] == 1:
        os._exit(7)
    return square(case)


def test_a_process_that_dies_is_reported(tmp_path):
    with pytest.raises(NumericalError, match="worker process died"):
        run_cases(dies, CASES, tmp_path, jobs=2)
    assert run_cases(square, CASES, tmp_path) == EXPECTED


def raises_with_data(case):
    raise UnstableLoopError("no", spectral_radius=1.5)


def test_errors_come_back_with_their_data(tmp_path):
    with pytest.raises(UnstableLoopError, match="no") as caught:
        run_cases(raises_with_data, CASES, tmp_path, jobs=2)
    assert caught.value.spectral_radius == 1.5
