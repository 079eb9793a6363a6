"""An edited gain file whose digest is written again: never taken for a certified design."""

from collections import Counter
from dataclasses import replace

import pytest
from support.gain_file_edits import (
    COMMANDS,
    ENDINGS,
    ORIGINALS,
    Edit,
    command,
    judge,
    random_edits,
    run_quietly,
    saved,
)

from lbt_synth.files.gain_file.store import load_with_digest

HARMLESS = ("refused", "no other design", "another claim that holds", "cannot be written")
QUICK = ("kalman", "bare", "integrator")


def refused_commands(name, ending, folder, commands):
    """Commands that do not take a file as it was written."""
    path = saved(name, ending).write(folder / f"{name}.{ending}")
    return [each for each in commands if run_quietly(command(each, path))[0] != 0]


def test_a_sample_of_edits(tmp_path):
    for name, ending in zip(QUICK, (*ENDINGS, "npz"), strict=True):
        assert not refused_commands(name, ending, tmp_path, ("verify",))
    verdicts = [judge(edit, tmp_path, ("verify",)) for edit in random_edits(40, 1, QUICK)]
    assert set(verdicts) <= set(HARMLESS), verdicts
    assert verdicts.count("refused") > 30


@pytest.mark.study
def test_no_edit_is_taken_for_a_certified_design(tmp_path, capsys):
    """2,000 edits over methods and formats print the table of docs/gain_file.md."""
    for name in ORIGINALS:
        for ending in ENDINGS:
            assert not refused_commands(name, ending, tmp_path, ("verify", "show", "export"))
    assert not refused_commands("kalman", "npz", tmp_path, ("simulate",))
    counts = {name: Counter() for name in ORIGINALS}
    told = []
    for number, edit in enumerate(random_edits(2000)):
        verdict = judge(edit, tmp_path, COMMANDS if number % 10 == 0 else ("verify",))
        kind = verdict if verdict in HARMLESS else verdict.split()[0]
        counts[edit.design][kind] += 1
        if kind not in HARMLESS or (kind == "no other design" and not edit.is_note):
            told.append((verdict, edit.design, edit.ending, edit.place, edit.change))
    kinds = (*HARMLESS, "certified", "traceback", "more")
    with capsys.disabled():
        print(f"\n| design | {' | '.join(kinds)} |")
        for name, each in counts.items():
            print(f"| {name} | {' | '.join(str(each[kind]) for kind in kinds)} |")
        print(f"| all | {' | '.join(str(sum(c[k] for c in counts.values())) for k in kinds)} |")
        print(*told, sep="\n")
    assert not [entry for entry in told if entry[0] not in HARMLESS]


def test_another_claim_that_holds_has_another_digest(tmp_path):
    """The band's worst frequency is at its other end: from 9.09 Hz on it promises no less."""
    place = ("meta", "shaped", "specifications", 0, "objective", "terms", 1, "low_hz")
    edit = Edit("shaped", "npz", place, "times 1.01", 9.09)
    assert judge(edit, tmp_path, ("verify",)) == "another claim that holds"
    contents = (saved("shaped", "npz"), saved("shaped", "npz").changed(edit))
    digests = [load_with_digest(each.write(tmp_path / "g.npz"))[1] for each in contents]
    assert digests[0] != digests[1]
    wider = replace(edit, place=(*place[:-1], "high_hz"), value=12.0)  # it leaves more there
    assert judge(wider, tmp_path, ("verify",)) == "refused"


def test_a_demand_that_is_there_twice_is_refused(tmp_path):
    place = ("meta", "shaped", "specifications", 0, "demands")
    demands = saved("shaped", "npz").parts["meta"]["shaped"]["specifications"][0]["demands"]
    edit = Edit("shaped", "npz", place, "longer", [*demands, *demands])
    assert judge(edit, tmp_path, ("verify",)) == "refused"
