"""The autopsy of records: of good ones, and of those of which little can be said.

Three sentences: the record, what its residual is made of, what to change first.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, ordinary_loop, run_law
from support.diagnoses import GAIN, given_design, line_diagnosis, line_record, short_record
from support.recorded_loops import LINE

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.diagnosis import diagnosis_verdict
from lbt_synth.identification.prediction.comparison import INTEGRATOR, LIMIT, RAN


def test_a_good_record():
    found = line_diagnosis()
    assert found.doubt == ""
    assert found.law.kind == "pure integrator"
    assert found.law.gain[0, 0] == pytest.approx(GAIN)
    assert found.loop.delay_frames == 2
    assert found.loop.spectral_radius < 1
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(LINE[0][0], abs=0.2)
    assert line.origin == "one axis"
    names = [row.name for row in found.residuals]
    assert names[0] == RAN
    assert names[-1] == LIMIT
    assert {INTEGRATOR, found.best, "robust controller", "mine"} < set(names)
    # the law that was found promises what the record shows
    ran = found.row(RAN)
    assert abs(ran.deviations) < 4
    least = min(found.row(name).replayed_nm for name in names if name not in (RAN, LIMIT, "mine"))
    assert found.row(found.best).replayed_nm == pytest.approx(least, rel=0.05)
    loop = lbt.close_loop(found.model.hardware, found.best_design.controller)
    assert loop.is_stable
    assert found.row("nothing") is None


def test_a_given_design():
    row = line_diagnosis().given
    assert (row.design, row.method, row.stable) == ("mine", "Kalman filter", True)
    assert row.replayed_nm == line_diagnosis().row("mine").replayed_nm
    low, high = (float(end) for end in row.stable_gains.split(" to "))
    assert low < line_diagnosis().model.sensor_gains[0] < high
    assert row.agreement.startswith("no: more than promised")
    assert any("assumes a sensor gain of 1.000 on axis 0" in n for n in line_diagnosis().notes)


@pytest.mark.parametrize(
    ("change", "doubt", "repair"),
    [(-1.0, "they have the opposite sign", "--command-sign -1"), (1.0, "", "")],
)
def test_a_short_record_has_channels_and_a_law(change, doubt, repair):
    found = lbt.identification.diagnose(short_record(change), given={"mine": given_design()})
    assert doubt in found.doubt
    assert repair in (found.commands.advice if found.commands else "")
    assert abs(found.law.gain[0, 0]) == pytest.approx(GAIN)
    assert found.model is found.comparison is found.given is None
    assert found.costs == found.lines == found.residuals == ()
    assert len(found.channels) == 2
    (note,) = found.notes
    expected = "the given design was not tried" if doubt else "no model: the record needs 2000"
    assert note.startswith(expected)


@pytest.mark.parametrize(
    ("make", "doubt", "repair"),
    [
        (lambda y, u: (y, u[:, ::-1]), "axes are exchanged", "--swap-axes"),
        (lambda y, u: (y[:-1], u[1:]), "1 frame early", "--command-shift-frames 1"),
        (lambda y, u: (y[1:], np.diff(u, axis=0)), "increments", "--command-increments"),
        (lambda y, u: (y[:3000], u[-3000:]), "nothing to do with", "find the commands"),
    ],
)
def test_commands_of_another_kind(make, doubt, repair):
    y, u = make(*ordinary_loop())
    record = lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    found = lbt.identification.diagnose(record)
    assert doubt in found.doubt
    assert repair in (found.commands.advice if found.commands else "")
    assert found.model is None
    assert found.law is not None


def test_a_record_too_short_for_a_likelihood_has_a_law():
    found = lbt.identification.diagnose(short_record(-1.0, frames=500))
    assert found.doubt == "by their law they have the opposite sign"
    assert found.commands.options == "--command-sign -1"
    longer = lbt.identification.diagnose(short_record(-1.0, frames=900))
    assert longer.commands.options == "--command-sign -1"  # with a likelihood it is named


def test_an_open_loop():
    record = line_record()
    series = lbt.identification.loop_record(
        record.pseudo_open_loop(0.6)[2:], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    found = lbt.identification.diagnose(series)
    assert found.law is None
    assert found.loop.stable_gains == ""
    assert found.row(RAN) is None
    assert np.isnan(found.costs[-1].running_nm)
    assert found.costs[-1].best_nm > 0


def test_a_design_of_another_loop():
    two = lbt.kalman(
        lbt.tip_tilt_plant(
            frame_rate_hz=RATE,
            turbulence=lbt.models.ARModel(
                coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE
            ),
            noise_nm=5.0,
        )
    )
    with pytest.raises(lbt.errors.ProblemError, match="2 measurements and 2 commands, and the rec"):
        lbt.identification.diagnose(line_record(), given={"two": two})


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
    assert found.costs[-1].running_nm == pytest.approx(ran.model_nm, rel=1e-6)
    assert found.costs[-1].best_nm == pytest.approx(found.row(found.best).model_nm, rel=1e-6)


def test_data_that_contradict_the_model_of_what_ran():
    found = line_diagnosis()
    assert ", which the data contradict" not in diagnosis_verdict(found)[1]
    entries = tuple(
        replace(entry, model_nm=2 * entry.model_nm) if entry.name == "what ran" else entry
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
        replace(best, name="what ran") if entry.name == "what ran" else entry
        for entry in found.comparison.entries
    )
    same = replace(found, comparison=replace(found.comparison, entries=entries))
    assert diagnosis_verdict(same)[2].startswith(f"Change nothing: the {found.best} would leave")


def test_where_the_gain_is_what_is_wrong():
    found = line_diagnosis()
    best = found.row(found.best)
    entries = tuple(
        replace(best, name=entry.name) if entry.name == "best integrator" else entry
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
    found = lbt.identification.diagnose(record)
    found = replace(found, commands=replace(found.commands, accepted=True))
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
    assert line.where == ""
    assert replace(line, origin="a diagonal", direction_deg=30.0).where == " along 30 deg"
    assert replace(line, origin="tilt", direction_deg=90.0).where == " in tilt"
    costs = tuple(replace(row, where=" in tilt") for row in found.costs)
    (name,) = (row.part for row in costs if row.part.startswith("line"))
    assert f"nm of the {name} in tilt" in diagnosis_verdict(replace(found, costs=costs))[1]
