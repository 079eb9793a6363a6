"""Three sentences: the record, what its residual is made of, what to change first."""

from dataclasses import replace

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, run_law
from support.diagnoses import line_diagnosis, line_record, short_record

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.rows import line_name, line_place
from lbt_synth.identification.diagnosis.verdict import diagnosis_verdict
from lbt_synth.identification.prediction.comparison import INTEGRATOR, RAN


def with_residuals(**changes):
    """The diagnosis of a record, with rows of its comparison in place of others, by attributes."""
    found = line_diagnosis()
    rows = {row.name: row for row in found.comparison.entries} | {
        name: replace(row, name=name) for name, row in changes.items()
    }
    table = replace(found.comparison, entries=tuple(rows.values()))
    return replace(found, comparison=table)


def scaled(name, factor):
    """A row of the comparison whose residual is larger by a factor."""
    row = line_diagnosis().row(name)
    residual = row.replayed
    parts = {
        "measured_nm": factor * residual.measured_nm,
        "noise_nm2": factor**2 * residual.noise_nm2,
        "covariance_nm2": factor**2 * residual.covariance_nm2,
        "error_nm4": factor**4 * residual.error_nm4,
    }
    return replace(row, replayed=replace(residual, **parts), replayed_nm=factor * row.replayed_nm)


def test_of_a_good_record():
    """All residuals are those on unseen data; of the model there are shares of a variance."""
    found = line_diagnosis()
    state, residual, advice = diagnosis_verdict(found)
    assert state.startswith("The record is sound: a pure integrator of gain 0.2 ran, stable at")
    ran, best, slow = (found.row(name).replayed for name in (RAN, found.best, INTEGRATOR))
    assert residual.startswith(f"It leaves {ran.text} on unseen data (")
    start, stop = ran.stretches[0]
    y = line_record().measurements[start:stop]
    noise_nm = np.sqrt(ran.noise_nm2[0, 0])
    measured = f"({np.sqrt(np.mean(y**2)):.3g} nm were measured at this sensor gain, and "
    assert f"{measured}{noise_nm:.3g} nm are noise; Strehl ratio" in residual
    gain = np.sqrt(np.mean(y**2) / ran.measured_nm2)  # the same as of the first sentence
    assert gain == pytest.approx(found.model.sensor_gains[0], rel=1e-9)
    share = (found.costs[0].running_nm / found.costs[-1].running_nm) ** 2
    assert f": by the model {100 * share:.0f} % of the {found.costs[0].part}" in residual
    assert advice.startswith(
        f"First change the controller: the {found.best} leaves {best.text} on unseen data"
    )
    assert advice.endswith(f". The best integrator leaves {slow.text}.")
    assert found.costs[-1].running_nm == pytest.approx(found.row(RAN).model_nm, rel=1e-6)
    assert found.costs[-1].best_nm == pytest.approx(found.row(found.best).model_nm, rel=1e-6)


def test_data_that_contradict_the_model_of_what_ran():
    assert "contradict" not in diagnosis_verdict(line_diagnosis())[1]
    row = replace(line_diagnosis().row(RAN), model_nm=500.0)
    residual = diagnosis_verdict(with_residuals(**{RAN: row}))[1]
    assert residual.endswith("; the data contradict the model, which expects 500 nm.")


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
    same = with_residuals(**{RAN: found.row(found.best)})
    assert diagnosis_verdict(same)[2] == (
        f"Change nothing: of all that was tried the {found.best} leaves least, "
        f"{found.row(found.best).replayed.text}."
    )


def test_a_gain_is_not_changed_for_one_that_leaves_more():
    """The integrator leaves more than what ran, and the best design little less."""
    found = line_diagnosis()
    best, slow = found.row(found.best), scaled(found.best, 1.02)
    rows = {RAN: scaled(found.best, 1.01), INTEGRATOR: slow}
    assert diagnosis_verdict(with_residuals(**rows))[2].startswith("Change nothing: of all")
    # much better than what ran, but the integrator is not
    rows = {RAN: scaled(found.best, 1.5), INTEGRATOR: scaled(found.best, 1.6)}
    advice = diagnosis_verdict(with_residuals(**rows))[2]
    assert advice.startswith(f"First change the controller: the {found.best} leaves ")
    assert best.replayed.text in advice


def test_where_the_gain_is_what_is_wrong():
    found = line_diagnosis()
    tuned = with_residuals(**{INTEGRATOR: scaled(found.best, 1.02)})
    advice = diagnosis_verdict(tuned)[2]
    assert advice.startswith("First change the gain from 0.2 to ")
    least = found.row(found.best).replayed.text
    assert advice.endswith(f" on unseen data, the {found.best} {least}.")


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
    found = lbt.identification.diagnose(record)
    found = replace(found, commands=replace(found.commands, explanation="as given"))
    state = diagnosis_verdict(found)[0]
    assert (
        state
        == "The record shows no fault, and a pure integrator of gain 0.3, 0.2 ran, 1 frame late."
    )


def test_of_a_loop_near_its_limit():
    found = line_diagnosis()
    near = replace(found, loop=replace(found.loop, values={**found.loop.values, "modulus": 0.12}))
    assert diagnosis_verdict(near)[0].endswith(" but with a modulus margin of 0.12 only.")
    wild = replace(
        found, loop=replace(found.loop, values={**found.loop.values, "spectral_radius": 1.02})
    )
    assert "which is UNSTABLE at the sensor gain of" in diagnosis_verdict(wild)[0]


def test_along_what_a_line_shakes():
    found = line_diagnosis()
    (line,) = found.lines
    assert line_place(replace(line, direction=(0.866, 0.5))) == " along 30 deg"
    assert line_place(replace(line, direction=(0.0, 1.0))) == " in tilt"
    costs = tuple(replace(row, where=" in tilt") for row in found.costs)
    (name,) = (row.part for row in costs if row.part.startswith("line"))
    assert f"% of the {name} in tilt" in diagnosis_verdict(replace(found, costs=costs))[1]


def test_a_wide_resonance_is_no_line():
    (line,) = line_diagnosis().lines
    assert line_name(line).startswith("line at ")
    assert line_name(replace(line, kind="broad")).startswith("broad resonance at ")
