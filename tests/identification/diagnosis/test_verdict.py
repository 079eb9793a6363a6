"""Three sentences: the record, what its residual is made of, what to change first."""

from dataclasses import replace

import numpy as np
from support.control_laws import RATE, SteppedLaw, run_law
from support.diagnoses import line_diagnosis, short_record

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.verdict import diagnosis_verdict


def test_of_a_good_record():
    found = line_diagnosis()
    state, residual, advice = diagnosis_verdict(found)
    assert state.startswith("The record is sound: a pure integrator of gain 0.2 ran, stable at")
    ran = found.row("what ran")
    assert f"It leaves {ran.replayed_nm:.3g} +- " in residual
    assert f"{found.costs[0].running_nm:.3g} nm of the {found.costs[0].part}" in residual
    assert advice.startswith(f"First change the controller: the {found.best} leaves ")
    limit = f"; by the model no linear controller leaves less than {found.limit_nm:.3g} nm"
    assert limit in advice
    assert 0 < found.limit_nm < found.costs[-1].best_nm * (1 + 1e-9)  # of the same model


def test_data_that_contradict_the_model_of_what_ran():
    found = line_diagnosis()
    assert ", which the data contradict" not in diagnosis_verdict(found)[1]
    entries = tuple(
        replace(entry, model_nm2=4 * entry.model_nm2) if entry.name == "what ran" else entry
        for entry in found.comparison.entries
    )
    other = replace(found, comparison=replace(found.comparison, entries=entries))
    assert (
        f"{found.costs[-1].running_nm:.3g} nm, which the data contradict: "
        in (diagnosis_verdict(other)[1])
    )


def test_of_one_that_must_not_be_used():
    found = lbt.identification.diagnose(short_record(-1.0))
    assert diagnosis_verdict(found) == (
        "The commands are not those that the mirror followed: they have the opposite sign.",
        "Nothing can be said of its residual.",
        "First read the record with --command-sign -1.",
    )


def test_of_one_with_a_fault():
    channel = replace(line_diagnosis().channels[0], state="stuck (12 %)", faulty=0.12)
    state, _, advice = diagnosis_verdict(replace(line_diagnosis(), channels=(channel,)))
    assert state == "The record has faults: the measurement is stuck (12 %)."
    assert advice == "First look at the measurement, which is stuck (12 %)."


def test_a_fault_of_a_channel_may_be_what_is_wrong_with_the_commands():
    found = lbt.identification.diagnose(short_record(-1.0))
    channel = replace(found.channels[0], state="noisy")
    state, _, advice = diagnosis_verdict(replace(found, channels=(channel,)))
    assert state.endswith("The record has faults, too: the measurement is noisy.")
    assert advice == "First look at the measurement, which is noisy."


def test_of_a_short_one():
    _, residual, advice = diagnosis_verdict(lbt.identification.diagnose(short_record()))
    assert residual == "Nothing can be said of its residual."
    assert advice == "Record longer before anything is changed."


def test_where_nothing_can_be_gained():
    found = line_diagnosis()
    best = found.row(found.best)
    entries = tuple(
        replace(entry, replayed=best.replayed) if entry.name == "what ran" else entry
        for entry in found.comparison.entries
    )
    same = replace(found, comparison=replace(found.comparison, entries=entries))
    assert diagnosis_verdict(same)[2].startswith(f"Change nothing: the {found.best} would leave")


def test_where_the_gain_is_what_is_wrong():
    found = line_diagnosis()
    best = found.row(found.best)
    entries = tuple(
        replace(entry, replayed=best.replayed) if entry.name == "best integrator" else entry
        for entry in found.comparison.entries
    )
    tuned = replace(found, comparison=replace(found.comparison, entries=entries))
    assert diagnosis_verdict(tuned)[2].startswith("First change the gain from 0.2 to ")


def test_where_the_delay_is_doubtful():
    note = "warning: a delay of 3 frames fits better than 2 (its criterion is better by 90)"
    state, _, advice = diagnosis_verdict(replace(line_diagnosis(), notes=(note,)))
    assert state.startswith("The delay of the record is doubtful: a delay of 3 frames fits")
    assert advice.startswith("First check the delay")


def test_a_loop_of_a_law_that_is_late():
    y, u = run_law(SteppedLaw(np.diag([0.3, 0.2])), frames=3000)
    record = lbt.identification.loop_record(
        y[1:], u[:-1], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    found = replace(lbt.identification.diagnose(record), doubt="")
    state = diagnosis_verdict(found)[0]
    assert (
        state
        == "The record shows no fault, and a pure integrator of gain 0.3, 0.2 ran, 1 frame late."
    )


def test_of_a_loop_near_its_limit():
    found = line_diagnosis()
    near = replace(found, loop=replace(found.loop, modulus=0.12))
    assert diagnosis_verdict(near)[0].endswith(" but with a modulus margin of 0.12 only.")
    wild = replace(found, loop=replace(found.loop, spectral_radius=1.02))
    assert "which is UNSTABLE at the sensor gain of" in diagnosis_verdict(wild)[0]


def test_along_what_a_line_shakes():
    found = line_diagnosis()
    (line,) = found.lines
    for origin, angle, words in (("a diagonal", 30.0, "along 30 deg"), ("tilt", 90.0, "in tilt")):
        row = replace(line.row, origin=origin, direction_deg=angle)
        turned = replace(found, lines=(replace(line, row=row),))
        assert f"nm of the {line.name} {words}" in diagnosis_verdict(turned)[1]
