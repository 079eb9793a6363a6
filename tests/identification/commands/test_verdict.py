"""The verdict on commands: faults are named with what repairs them, good records pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.control_laws import PATH, TRUTH, SteppedLaw, ordinary_loop, run_law
from support.recorded_loops import LINE, RATE, resonant_record, spliced_record
from support.structures import structure
from support.wrong_commands import FAULTS, record, wrong_record

import lbt_synth as lbt
from lbt_synth.identification import loop_record
from lbt_synth.identification.commands.repair import repair_commands
from lbt_synth.identification.commands.verdict import (
    AS_GIVEN,
    explain_commands,
    judge_fitted_gains,
    likely_factors,
    list_repairs,
)

CROWDED = """59.77816 0.00922046 26.618522 3.03506  147.00317 0.00861081 59.089946 1.09802
    45.176974 0.00286793 79.169178 1.63632  113.71687 0.00354196 80.716156 1.005
    88.666623 0.00215286 97.423308 0.092637"""  # lines: Hz, damping, nm, direction


def test_a_good_record_is_accepted() -> None:
    verdict = explain_commands(record(*ordinary_loop(1)))
    assert (verdict.explanation, verdict.accepted, verdict.repair.options) == (AS_GIVEN, True, "")
    assert verdict.overruled == verdict.notes == ()
    np.testing.assert_allclose(verdict.gain, 0.7, rtol=0.25)
    verdict.require_accepted()


def test_a_filter_is_known_although_its_measurements_were_rounded() -> None:
    """The short law that fits anticipates, or turns an axis: it led to an unstable design."""
    config = lbt.load_config("examples/lbt.yaml")
    law = config.design("hinf", gamma_ratio=1.2, route="riccati").controller
    run = lbt.simulate(law, config.truth, hardware=config.hardware, frames=6000, seed=7)
    known = {"frame_rate_hz": config.hardware.frame_rate_hz, "delay_frames": 2, "unit": "nm"}
    for spacing_nm, shift, sign, options in (
        (4.0, 0, 1.0, ""),
        (4.0, 1, 1.0, "--command-shift-frames -1"),
        (2.0, 0, -1.0, "--command-sign 1 -1"),  # mirrored, and turned by degrees
    ):
        y = np.rint(run.measurements[0] / spacing_nm) * spacing_nm
        u = np.roll(run.commands[0], shift, axis=0) * [1.0, sign]
        verdict = explain_commands(loop_record(y[5:-5], u[5:-5], **known))
        assert verdict.repair.options == options


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_repaired(fault) -> None:
    wrong = wrong_record(fault)
    verdict = explain_commands(wrong)
    assert verdict.repair.options == FAULTS[fault][1].options
    with pytest.raises(lbt.errors.RecordError, match=verdict.explanation[:20]) as caught:
        verdict.require_accepted()
    assert caught.value.options == verdict.repair.options
    assert verdict.explanation in verdict.overruled[0]
    if fault == "turned":
        assert explain_commands(repair_commands(wrong, verdict.repair)).accepted


def test_a_delay_that_stays_open_is_said() -> None:
    """Eight seconds of a weak loop tell no frame from the next; ten of a strong one do."""
    weak = spliced_record(lines=LINE, frames=8000, gain=0.03)
    (note,) = explain_commands(weak).notes
    assert note.endswith(
        "delay open: 1 or 3 explain it as well as the 2 frames that are given and taken"
    )


def test_a_wrong_delay() -> None:
    """The coarse spectrum alone finds a delay of 1.5 frames likelier than 2.5, by 121."""
    record = spliced_record(lines=LINE, frames=20_000)
    assert explain_commands(record.with_delay(2.5)).accepted  # 20 s hardly tell half a frame
    repair = explain_commands(record.with_delay(3.0)).repair
    assert (repair.options, repair.delay_frames) == ("--delay-frames 2", 2)


def test_commands_that_are_shaken_need_no_law() -> None:
    rng = np.random.default_rng(7)
    u = 40 * np.repeat(rng.standard_normal((200, 2)), 20, axis=0)
    y = np.zeros((4000, 2))
    y[2:] = -0.5 * u[:-2]
    y += 5 * rng.standard_normal(y.shape)
    verdict = explain_commands(record(y, u))
    assert verdict.accepted
    np.testing.assert_allclose(verdict.gain, 0.5, rtol=0.05)


def test_a_slow_computer_is_not_a_late_record() -> None:
    """The law uses old measurements, and the mirror follows the commands as recorded."""
    law = lbt.Controller(
        A=[[1.0, 0.3], [0.0, 0.0]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    truth = replace(TRUTH, vibrations=())
    verdict = explain_commands(record(*run_law(law, truth=truth, hardware=path, frames=10_000)))
    assert verdict.accepted
    assert verdict.law.lag_frames == 1
    assert verdict.law.lag_text == ", 1 frame late"
    assert "the total delay of a new design is 3 frames" in verdict.notes[0]


def test_a_law_may_couple_the_axes_on_purpose() -> None:
    y, u = run_law(SteppedLaw([[0.4, 0.1], [-0.1, 0.3]]))
    assert explain_commands(record(y, u)).accepted


def test_the_law_decides_where_crowded_lines_mislead_a_coarse_spectrum() -> None:
    """By the spectrum, commands that are a frame late are likelier as given, by 1700."""
    air = lbt.models.ARModel(
        coefficients=[1.99180077, -0.991819641], driving_rms_nm=0.33053314, frame_rate_hz=RATE
    )
    lines = [
        lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=rms, direction=(np.cos(a), np.sin(a)))
        for f, damping, rms, a in np.reshape(CROWDED.split(), (-1, 4)).astype(float)
    ]
    truth = lbt.Truth(turbulence=air, vibrations=lines, noise_nm=4.082686, sensor_gain=0.8558551)
    law = lbt.integrator(PATH, gain=0.40405704).controller
    y, u = (series[1000:] for series in run_law(law, truth=truth, frames=31_000, seed=198))
    spoil, repair = FAULTS["late"]
    assert explain_commands(record(*spoil(y, u))).repair.options == repair.options


def test_a_known_gain_decides_on_the_scale() -> None:
    y, u = (series[:3000] for series in ordinary_loop())
    assert explain_commands(record(y, u / 2), sensor_gain=[1.2, 1.6]).accepted
    verdict = explain_commands(record(y[:, :1], u[:, :1]), sensor_gain=0.1)
    assert verdict.repair.options.startswith("--command-scale")
    open_loop = loop_record(y, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    for seen, gain, words in (
        (open_loop, None, "no commands to explain"),
        (record(y, u), [0.6, 0.8, 0.7], "sensor_gain must be one number"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            explain_commands(seen, sensor_gain=gain)


def test_a_record_without_long_stretches_is_not_tested() -> None:
    y, u = (series.copy() for series in ordinary_loop())
    y[::400] = np.nan
    verdict = explain_commands(record(y, u))
    assert verdict.accepted
    assert "not tested" in verdict.notes[0]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda y, u: (u, y), "as if both had been exchanged"),
        (lambda y, u: (y, u[:, [0, 0]]), "one axis was recorded twice"),
        (
            lambda y, u: (y[1:], np.column_stack([u[1:, 0], u[:-1, 1]])),
            "those of axis 1 follow their measurements 1 frame later than those of axis 0",
        ),
        (
            lambda y, u: (y[:, :1], ordinary_loop(2)[1][:, :1]),
            "they have nothing to do with the measurements",
        ),
        (
            lambda y, u: (y, np.column_stack([u[:, 0], ordinary_loop(2)[1][:, 1]])),
            "those of axis 1 have nothing to do with its measurements",
        ),
        (
            lambda y, u: (np.diff(y[:3000, :1], axis=0), u[1:3000, :1]),
            "unstable at any sensor gain",
        ),
    ],
)
def test_what_cannot_be_is_named(spoil, words: str) -> None:
    verdict = explain_commands(record(*spoil(*ordinary_loop())))
    assert words in verdict.explanation
    assert not verdict.accepted
    assert verdict.repair.options == ""


def test_an_axis_whose_commands_stand_still_is_an_open_loop() -> None:
    y, u = (series[:5000] for series in ordinary_loop())
    still = u * [1.0, 0.0]
    verdict = explain_commands(record(y, still))
    assert verdict.accepted
    assert verdict.notes[-1] == "the commands of axis 1 stand still: its loop was open"
    assert explain_commands(record(y, still), sensor_gain=[0.6, 0.7]).notes == verdict.notes
    assert np.isnan(verdict.gain[1])
    assert verdict.gain[0] == pytest.approx(0.7, rel=0.3)
    assert explain_commands(record(y, -still)).repair.options == "--command-sign -1"


def test_a_long_shift_is_that_of_the_law() -> None:
    y, u = ordinary_loop()
    verdict = explain_commands(record(y[8:], u[:-8]))
    assert verdict.repair.options == "--command-shift-frames -8"


def test_what_a_law_leaves_unexplained_is_said() -> None:
    """Steps of 6 nm leave the gain at 0.46 in place of 0.7; in 30 nm it drowns."""
    y, u = (series[:3000, :1] for series in ordinary_loop())
    for step_nm in (6.0, 30.0):
        seen = record(y, step_nm * np.round(u / step_nm))
        verdict = explain_commands(seen, sensor_gain=None if step_nm < 30 else 0.7)
        assert verdict.accepted is (step_nm < 30)
        assert verdict.repair.options == ""
        words = (*verdict.notes, verdict.explanation)
        assert any("of their changes unexplained" in sentence for sentence in words)


def test_a_weak_loop_leaves_the_unit_of_its_commands_open():
    """Quick fits of plausible gains are nearly as likely as one of 7: it is said, not refused."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    law, air = lbt.integrator(path, gain=0.1).controller, replace(TRUTH, vibrations=())
    y, u = run_law(law, truth=air, hardware=path, frames=6000)
    verdicts = [explain_commands(record(y, factor * u)) for factor in (1.0, 0.1)]
    assert all(verdict.accepted for verdict in verdicts)
    warned = [["as if the commands were too small" in n for n in v.notes] for v in verdicts]
    assert [any(row) for row in warned] == [False, True]


def test_gains_far_above_plausible_ones_are_another_unit():
    for gains, errors, options in (
        ([1.6, 1.62], [0.02, 0.02], "--command-scale 2"),
        ([700.0], [5.0], "--command-scale 1000"),
        ([1.6, 1.62], [0.1, 0.1], ""),
        ([1.6, 0.8], [0.02, 0.02], ""),  # not the unit: the axes differ
        ([0.1, 0.1], [0.001, 0.001], ""),
    ):
        verdict = judge_fitted_gains(np.array(gains), np.array(errors))
        assert (verdict.repair.options, verdict.accepted) == (options, not options)
        doubts = [("times too small" in words) for words in verdict.overruled]
        assert doubts == [True] * bool(options)


def test_the_first_repair_is_none() -> None:
    repairs = list_repairs(2, 2.0)
    assert [repair.options for repair in repairs].index("") == 0
    assert {repair.options for repair in repairs[1:]}.isdisjoint({""})
    for lag, least in ((0, -1), (2, -3), (5, -5)):  # a total delay of one frame is the least
        shifts = [repair.shift_frames for repair in list_repairs(2, 2.0, lag=lag)]
        assert (min(shifts), max(shifts)) == (least, 3)


def test_units_are_powers_of_ten_however_coarse_the_gain() -> None:
    """One factor stands for all axes where no gain is plausible: 6 and 13 were 10 and 100."""
    implausible, one = np.zeros(2, dtype=bool), np.array([True, False])
    for factor in (1e-9, 1e3):
        for gain in (0.3, 1.64):
            gains = factor * gain * np.array([0.9, 1.1])
            np.testing.assert_allclose(likely_factors(gains, implausible), [factor] * 2)
    assert likely_factors(np.array([6.0, 13.0]), implausible).tolist() == [10, 10]
    assert likely_factors(np.array([0.8, 1.6]), one).tolist() == [1, 2]


@pytest.mark.parametrize("factor", [1.0, pytest.param(0.1, marks=pytest.mark.study), 1e3])
def test_wide_resonances_hide_no_other_unit(factor: float) -> None:
    """The coarse gain is twice the true one here: a factor of two is left to the fit."""
    made = resonant_record()
    verdict = explain_commands(replace(made, commands=factor * made.commands))
    assert verdict.repair.scale == (() if factor == 1 else (pytest.approx(1 / factor),))


def test_a_known_gain_holds_after_a_repair() -> None:
    """By its spectrum another delay was likelier, at which one axis had a seventh of the gain."""
    seen = structure(138).record(0, 10_000)
    assert explain_commands(seen, sensor_gain=[1.0]).doubt == ""
