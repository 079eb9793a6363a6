"""The autopsy of records: of good ones, and of those of which little can be said."""

import numpy as np
import pytest
from support.control_laws import RATE, ordinary_loop
from support.diagnoses import GAIN, given_design, line_diagnosis, line_record, short_record
from support.recorded_loops import LINE

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.rows import disturbance_lines
from lbt_synth.identification.prediction.comparison import INTEGRATOR, LIMIT, RAN


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
