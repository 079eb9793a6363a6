"""The autopsy of records: of good ones, and of those of which little can be said.

Its three sentences: the record, what its residual is made of, what to change first.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, ordinary_loop, run_law
from support.diagnoses import GAIN, given_design, line_diagnosis, line_record, short_record
from support.recorded_loops import LINE

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.diagnosis.rows import disturbance_lines, line_name
from lbt_synth.identification.prediction.comparison import INTEGRATOR, LIMIT, RAN
from lbt_synth.models import ARModel


def test_a_good_record():
    found = line_diagnosis()
    assert found.doubt == ""
    assert found.law.kind == "pure integrator"
    assert found.law.gain[0, 0] == pytest.approx(GAIN)
    assert found.loop.delay_frames == 2
    assert found.loop.spectral_radius < 1
    (line,) = disturbance_lines(found.model)
    assert line.frequency_hz == pytest.approx(LINE[0][0], abs=0.2)
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
    found = line_diagnosis()
    assert found.row("mine").replayed_nm > 3 * given_design().rms
    promise, assumption = (note for note in found.notes if note.startswith("mine "))
    start = (
        f"mine promises {given_design().rms:.3g} nm by its own model, and its loop is stable at "
    )
    assert promise.startswith(start)
    low, high = (float(end) for end in promise.split(" gains of ")[1].split(" to "))
    assert low < found.model.sensor_gains[0] < high
    assert "assumes a sensor gain of 1.000 on axis 0" in assumption


@pytest.mark.parametrize(
    ("change", "doubt", "repair"),
    [(-1.0, "they have the opposite sign", "--command-sign -1"), (1.0, "", "")],
)
def test_a_short_record_has_channels_and_a_law(change, doubt, repair):
    found = lbt.identification.diagnose(short_record(change), given={"mine": given_design()})
    assert doubt in found.doubt
    assert repair in (found.commands.advice if found.commands else "")
    assert abs(found.law.gain[0, 0]) == pytest.approx(GAIN)
    assert found.model is found.comparison is None
    assert found.costs == found.residuals == ()
    assert len(found.channels) == 2
    (note,) = found.notes
    expected = "the given design was not tried" if doubt else "no model: the record needs 2000"
    assert note.startswith(expected)
    state, residual, advice = found.verdict
    assert residual == "Nothing can be said of its residual."
    if not doubt:
        assert advice == "Record longer before anything is changed."
        return
    assert state == f"The commands are not those that the mirror followed: {doubt}."
    assert advice == "First read the record with --command-sign -1."
    # a fault of a channel may be what is wrong with them
    channel = replace(found.channels[0], state="noisy")
    state, _, advice = replace(found, channels=(channel,)).verdict
    assert state.startswith("The record has faults: the measurement is noisy. The commands are ")
    assert advice == "First look at the measurement, which is noisy."


@pytest.mark.parametrize(
    ("make", "doubt", "repair"),
    [
        (lambda y, u: (y, u[:, ::-1]), "axes are exchanged", "--swap-axes"),
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
            turbulence=ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE),
            noise_nm=5.0,
        )
    )
    with pytest.raises(ProblemError, match="2 measurements and 2 commands, and the rec"):
        lbt.identification.diagnose(line_record(), given={"two": two})


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
    state, residual, advice = found.verdict
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
    assert "contradict" not in line_diagnosis().verdict[1]
    row = replace(line_diagnosis().row(RAN), model_nm=500.0)
    residual = with_residuals(**{RAN: row}).verdict[1]
    assert residual.endswith("; the data contradict the model, which expects 500 nm.")


def test_of_one_with_a_fault():
    channel = replace(line_diagnosis().channels[0], state="stuck (12 %)", faulty=0.12)
    state, _, advice = replace(line_diagnosis(), channels=(channel,)).verdict
    assert state == "The record has faults: the measurement is stuck (12 %)."
    assert advice == "First look at the measurement, which is stuck (12 %)."
    note = "warning: a delay of 3 frames fits better than 2 (its criterion is better by 90)"
    state, _, advice = replace(line_diagnosis(), notes=(note,)).verdict
    assert state.startswith("The delay of the record is doubtful: a delay of 3 frames fits")
    assert advice.startswith("First check the delay")


def test_where_nothing_can_be_gained():
    found = line_diagnosis()
    same = with_residuals(**{RAN: found.row(found.best)})
    assert same.verdict[2] == (
        f"Change nothing: of all that was tried the {found.best} leaves least, "
        f"{found.row(found.best).replayed.text}."
    )


def test_a_gain_is_not_changed_for_one_that_leaves_more():
    """The integrator leaves more than what ran, and the best design little less."""
    found = line_diagnosis()
    best, slow = found.row(found.best), scaled(found.best, 1.02)
    rows = {RAN: scaled(found.best, 1.01), INTEGRATOR: slow}
    assert with_residuals(**rows).verdict[2].startswith("Change nothing: of all")
    # much better than what ran, but the integrator is not
    rows = {RAN: scaled(found.best, 1.5), INTEGRATOR: scaled(found.best, 1.6)}
    advice = with_residuals(**rows).verdict[2]
    assert advice.startswith(f"First change the controller: the {found.best} leaves ")
    assert best.replayed.text in advice


def test_where_the_gain_is_what_is_wrong():
    found = line_diagnosis()
    tuned = with_residuals(**{INTEGRATOR: scaled(found.best, 1.02)})
    advice = tuned.verdict[2]
    assert advice.startswith("First change the gain from 0.2 to ")
    least = found.row(found.best).replayed.text
    assert advice.endswith(f" on unseen data, the {found.best} {least}.")


def test_a_loop_of_a_law_that_is_late():
    y, u = run_law(SteppedLaw(np.diag([0.3, 0.2])), frames=3000)
    record = lbt.identification.loop_record(
        y[1:], u[:-1], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    found = lbt.identification.diagnose(record)
    found = replace(found, commands=replace(found.commands, explanation="as given"))
    state = found.verdict[0]
    assert (
        state
        == "The record shows no fault, and a pure integrator of gain 0.3, 0.2 ran, 1 frame late."
    )


def test_of_a_loop_near_its_limit():
    found = line_diagnosis()
    near = replace(found, loop=replace(found.loop, values={**found.loop.values, "modulus": 0.12}))
    assert near.verdict[0].endswith(" but with a modulus margin of 0.12 only.")
    wild = replace(
        found, loop=replace(found.loop, values={**found.loop.values, "spectral_radius": 1.02})
    )
    assert "which is UNSTABLE at the sensor gain of" in wild.verdict[0]
    tones = [each.findings[0].tone for each in (found, near, wild)]
    assert tones == ["good", "note", "bad"]


def test_along_what_a_line_shakes():
    found = line_diagnosis()
    (line,) = disturbance_lines(found.model)
    assert line_name(line).startswith("line at ")
    assert line_name(line).endswith(" Hz")
    assert line_name(replace(line, kind="broad")).startswith("broad resonance at ")
    assert line_name(replace(line, direction=(0.866, 0.5))).endswith(" Hz along 30 deg")
    assert line_name(replace(line, direction=(0.0, 1.0))).endswith(" Hz in tilt")
    (part,) = (row.part for row in found.costs if row.part.startswith("line"))
    assert f"% of the {part}" in found.verdict[1]
