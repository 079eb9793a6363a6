"""The autopsy of records, good ones and others, and its three sentences: state, residual, advice."""

from dataclasses import replace

import numpy as np
import pytest
from support.diagnoses import GAIN, given_design, line_diagnosis, line_record, short_record
from support.recorded_loops import LINE, RATE, spliced_record
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import diagnose, loop_record
from lbt_synth.identification.diagnosis import disturbance_lines, given_controller, line_name
from lbt_synth.identification.prediction.comparison import INTEGRATOR, LIMIT, RAN, compare_designs
from lbt_synth.identification.records.record import keep_frames, split_halves

LOOP = {"frame_rate_hz": RATE, "delay_frames": 2, "unit": "nm"}


@pytest.fixture(scope="session")
def good():
    return line_diagnosis()


def test_a_good_record(good):
    assert good.doubt == ""
    assert good.law.kind == "integrator"
    assert good.law.gain[0, 0] == pytest.approx(GAIN)
    assert good.loop.delay_frames == 2
    assert good.loop.spectral_radius < 1
    (line,) = disturbance_lines(good.model)
    assert line.frequency_hz == pytest.approx(LINE[0][0], abs=0.2)
    names = [row.name for row in good.residuals]
    assert (names[0], names[-1]) == (RAN, LIMIT)
    assert {INTEGRATOR, good.best, "robust controller", "mine"} < set(names)
    # the law that was found promises what the record shows
    assert abs(good.comparison[RAN].deviations) < 4
    designs = set(names) - {RAN, LIMIT, "mine"}
    least = min(good.comparison[name].replayed_nm for name in designs)
    assert good.comparison[good.best].replayed_nm == pytest.approx(least, rel=0.05)
    assert lbt.close_loop(good.model.hardware, good.best_design.controller).is_stable
    # a design that was given
    mine = given_design()
    assert good.comparison["mine"].replayed_nm > 3 * mine.rms
    (assumption,) = (note for note in good.notes if note.startswith("mine "))
    low, high = (float(end) for end in good.loop.stable_gains.split(" to "))
    assert low < good.model.sensor_gains[0] < high
    assert "assumes a sensor gain of 1.000 on axis 0" in assumption


def test_a_short_record_has_channels_and_a_law():
    right, turned = (diagnose(short_record(s), given={"mine": given_design()}) for s in (1.0, -1.0))
    assert right.doubt == ""
    assert "they have the opposite sign" in turned.doubt
    for diagnosis, words in (
        (right, "no model: the record needs 2000"),
        (turned, "the given design was not tried"),
    ):
        assert abs(diagnosis.law.gain[0, 0]) == pytest.approx(GAIN)
        assert diagnosis.model is diagnosis.comparison is None
        assert diagnosis.costs == diagnosis.residuals == ()
        assert len(diagnosis.channels) == 2
        assert diagnosis.notes[-1].startswith(words)
        assert diagnosis.verdict[1] == "Nothing can be said of its residual."
    assert len(right.notes) == 2  # with the delay, which so short a record leaves open
    assert right.verdict[2] == "Record longer before anything is changed."
    assert turned.verdict[::2] == (
        f"The commands are not those that the mirror followed: {turned.doubt}.",
        "First read the record with --command-sign -1.",
    )
    few = replace(right, commands=replace(right.commands, law=None))
    assert few.verdict[0].endswith("no fault, and so few frames do not tell which law ran.")
    lost = keep_frames(right.record, np.zeros(right.record.frames, dtype=bool))
    assert "100 % of the frames are lost" in replace(right, record=lost).verdict[0]
    # a fault of a channel may be what is wrong with them
    channel = replace(turned.channels[0], state="noisy")
    state, _, advice = replace(turned, channels=(channel,)).verdict
    assert state.startswith("The record has faults: the measurement is noisy. The commands are ")
    assert advice == "First look at the measurement, which is noisy."


def test_commands_of_another_time():
    y, u = line_record().measurements[:2500], line_record().commands[-2500:]
    found = diagnose(loop_record(y, u, **LOOP))
    assert "nothing to do with" in found.doubt
    assert "find the commands" in found.commands.advice
    assert found.model is None
    assert found.law is not None


def test_an_open_loop():
    found = diagnose(loop_record(line_record().pseudo_open_loop(0.6)[2:4500], **LOOP))
    assert found.law is None
    assert found.loop.stable_gains == ""
    assert found.comparison.row(RAN) is None
    assert np.isnan(found.costs[-1].running_nm)
    assert found.costs[-1].best_nm > 0


@pytest.mark.parametrize(
    ("rate_hz", "modes", "words"),
    [(RATE, 2, "2 measurements and 2 comm"), (2 * RATE, 1, "2000 Hz, .* has 1000 Hz")],
)
def test_a_design_of_another_loop(good, rate_hz, modes, words):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=rate_hz, modes=modes), gain=0.3)
    refused(lambda: given_controller(design, good.model), ProblemError, words)


def diagnosis_with(rows):
    """Return the diagnosis with rows of its comparison in place of others."""
    diagnosis = line_diagnosis()
    entries = {row.name: row for row in diagnosis.comparison.entries}
    entries |= {name: replace(row, name=name) for name, row in rows.items()}
    table = replace(diagnosis.comparison, entries=tuple(entries.values()))
    return replace(diagnosis, comparison=table)


def scaled(row, factor):
    """Return a row of the comparison whose residual is larger by a factor."""
    powers = {"measured_nm": 1, "noise_nm2": 2, "covariance_nm2": 2, "error_nm4": 4}
    parts = {key: factor**power * getattr(row.replayed, key) for key, power in powers.items()}
    replayed = replace(row.replayed, **parts)
    return replace(row, replayed=replayed, replayed_nm=factor * row.replayed_nm)


def test_sentences_of_a_good_record(good):
    """All residuals are those on unseen data; of the model there are shares of a variance."""
    state, residual, advice = good.verdict
    assert state.startswith("The record is sound: an integrator of gain 0.2 ran, stable at")
    ran, best, slow = (good.comparison[name].replayed for name in (RAN, good.best, INTEGRATOR))
    assert residual.startswith(f"It leaves {ran.text} on unseen data (")
    start, stop = ran.stretches[0]
    y = line_record().measurements[start:stop]
    noise_nm = np.sqrt(ran.noise_nm2[0, 0])
    measured = f"({np.sqrt(np.mean(y**2)):.3g} nm were measured at this sensor gain, and "
    assert f"{measured}{noise_nm:.3g} nm are noise)" in residual
    gain = np.sqrt(np.mean(y**2) / ran.measured_nm2)  # the same as of the first sentence
    assert gain == pytest.approx(good.model.sensor_gains[0], rel=1e-9)
    share = (good.costs[0].running_nm / good.costs[-1].running_nm) ** 2
    assert f": by the model {100 * share:.0f} % of the {good.costs[0].part}" in residual
    assert "contradict" not in residual
    words = f"First change the controller: the {good.best} leaves {best.text} on unseen data"
    assert advice.startswith(words)
    assert advice.endswith(f". The best integrator leaves {slow.text}.")
    assert good.costs[-1].running_nm == pytest.approx(good.comparison[RAN].model_nm, rel=1e-6)
    assert good.costs[-1].best_nm == pytest.approx(good.comparison[good.best].model_nm, rel=1e-6)


def test_what_is_advised(good):
    odd = diagnosis_with({RAN: replace(good.comparison[RAN], model_nm=500.0)})
    assert odd.verdict[1].endswith("; the data contradict the model, which expects 500 nm.")
    name, best = good.best, good.comparison[good.best]
    text = best.replayed.text
    nothing = f"Change nothing: of all that was tried the {name} leaves least, {text}."
    controller = f"First change the controller: the {name} leaves {text}"
    for ran, slow, start, end in (
        (1.0, None, nothing, nothing),
        (1.01, 1.02, "Change nothing: of all", ""),  # little more, and the integrator leaves more
        (1.5, 1.6, controller, ""),  # the integrator is not much better than what ran
        (None, 1.02, "First change the gain from 0.2 to ", f" on unseen data, the {name} {text}."),
    ):
        factors = {RAN: ran, INTEGRATOR: slow}
        rows = {key: scaled(best, factor) for key, factor in factors.items() if factor}
        advice = diagnosis_with(rows).verdict[2]
        assert advice.startswith(start)
        assert advice.endswith(end)


def test_of_a_loop_near_its_limit(good):
    loops = [
        replace(good, loop=replace(good.loop, values={**good.loop.values, **values}))
        for values in ({}, {"modulus": 0.12}, {"spectral_radius": 1.02})
    ]
    assert [loop.findings[0].tone for loop in loops] == ["good", "note", "bad"]
    assert loops[1].verdict[0].endswith(" but with a modulus margin of 0.12 only.")
    assert "which is UNSTABLE at the sensor gain of" in loops[2].verdict[0]


def test_along_what_a_line_shakes(good):
    (line,) = disturbance_lines(good.model)
    assert line_name(line).startswith("line at ")
    for changes, end in (({}, " Hz"), ({"direction": (0.866, 0.5)}, " Hz (30 deg)")):
        assert line_name(replace(line, **changes)).endswith(end)
    assert line_name(replace(line, kind="broad")).startswith("broad resonance at ")
    (part,) = (row.part for row in good.costs if row.part.startswith("line"))
    assert f"% of the {part}" in good.verdict[1]


def test_what_the_model_misses_has_its_band(good):
    """A fit of one line takes that at 60 Hz, and leaves the other to a predictor."""
    lines = ((25.0, 0.01, 200.0), (60.0, 0.02, 60.0))
    record = spliced_record((0,), lines=lines, frames=6000, sensor_gain=1.0)
    half = lbt.identify(split_halves(record)[0], sensor_gain=1.0, most_lines=1)
    table, _ = compare_designs(record, half, {"kalman": {}, "predictor": {}})
    shown = diagnosis_with({row.name: row for row in table.entries if row.replayed})
    missed, of_good = (
        [
            finding.sentence
            for finding in d.findings
            if finding.sentence.startswith("The model misses")
        ]
        for d in (shown, good)
    )
    (words,) = missed
    low, high = map(float, words.split(" between ")[1].removesuffix(" Hz.").split(" and "))
    assert 20 < low < 25 < high < 31
    assert of_good == []
