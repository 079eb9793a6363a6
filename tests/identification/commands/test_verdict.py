"""The verdict on commands: faults are named with what repairs them, good records pass.

The coarse spectrum by which repairs are compared.
"""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter
from support.control_laws import PATH, TRUTH, SteppedLaw, ordinary_loop, rotation, run_law
from support.recorded_loops import LINE, RATE, resonant_record, spliced_record
from support.refusals import refused, require_refusals
from support.structures import structure

import lbt_synth as lbt
from lbt_synth.identification import LoopRecord, loop_record
from lbt_synth.identification.commands import coarse_spectrum
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
from lbt_synth.identification.commands.verdict import (
    AS_GIVEN,
    explain_commands,
    judge_fitted_gains,
    likely_factors,
    list_repairs,
)
from lbt_synth.identification.fit.periodogram import segment_transforms

CROWDED = """59.77816 0.00922046 26.618522 3.03506  147.00317 0.00861081 59.089946 1.09802
    45.176974 0.00286793 79.169178 1.63632  113.71687 0.00354196 80.716156 1.005
    88.666623 0.00215286 97.423308 0.092637"""  # lines: Hz, damping, nm, direction


record = partial(loop_record, frame_rate_hz=RATE, delay_frames=2.0, unit="nm")
TURN = rotation(30)
FAULTS = {  # measurements and commands of the wrong record, and its repair
    "turned": (lambda y, u: (y, -u), CommandRepair(sign=(-1,))),
    "one turned": (lambda y, u: (y, u * [1, -1]), CommandRepair(sign=(1, -1))),
    "exchanged": (lambda y, u: (y, u[:, ::-1]), CommandRepair(swap_axes=True)),
    "rotated": (lambda y, u: (y, u @ TURN), CommandRepair(matrix=tuple(TURN.ravel()))),
    "1000 times": (lambda y, u: (y, 1000 * u), CommandRepair(scale=(0.001,))),
    "a tenth": (lambda y, u: (y, 0.1 * u), CommandRepair(scale=(10.0,))),
    "late": (lambda y, u: (y[1:], u[:-1]), CommandRepair(shift_frames=-1)),
    "far too late": (lambda y, u: (y[8:], u[:-8]), CommandRepair(shift_frames=-8)),
    "early": (lambda y, u: (y[:-2], u[2:]), CommandRepair(shift_frames=2)),
    "early, turned": (lambda y, u: (y[:-2], -u[2:]), CommandRepair(shift_frames=2, sign=(-1,))),
    "increments": (
        lambda y, u: (y, np.diff(u, axis=0, prepend=0)),
        CommandRepair(increments=True),
    ),
}
QUIET = {  # one axis without lines
    "truth": replace(TRUTH, vibrations=()),
    "hardware": lbt.LoopHardware(frame_rate_hz=RATE, modes=1),
}


def wrong_record(fault: str) -> LoopRecord:
    spoil, _ = FAULTS[fault]
    return record(*spoil(*ordinary_loop()))


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
    error = refused(verdict.require_accepted, lbt.errors.RecordError, verdict.explanation[:20])
    assert error.options == verdict.repair.options
    assert verdict.explanation in verdict.overruled[0]
    if fault == "turned":
        assert explain_commands(repair_commands(wrong, verdict.repair)).accepted


def test_records_that_are_accepted_with_a_note() -> None:
    """Laws may use old measurements and couple the axes, and ten strong seconds tell a delay."""
    y, u = ordinary_loop()
    torn = np.where(np.arange(len(y))[:, None] % 400 == 0, np.nan, y)
    weak = spliced_record(lines=LINE, frames=8000, gain=0.03)
    slow = lbt.Controller(
        A=[[1.0, 0.3], [0.0, 0.0]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE
    )
    late, coupled = (
        run_law(slow, frames=10_000, **QUIET),
        run_law(SteppedLaw([[0.4, 0.1], [-0.1, 0.3]])),
    )
    open_delay = "delay open: 1 or 3 explain it as well as the 2 frames that are given and taken"
    delay = "1 frame earlier. If the real-time computer takes that long, the total delay .* is 3 fr"
    for seen, words in (
        (weak, open_delay),
        (record(*late), delay),
        (record(torn, u), "not tested"),
        (record(*coupled), ""),
    ):
        verdict = explain_commands(seen)
        assert verdict.accepted
        assert re.search(words, " ".join(verdict.notes))


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


def test_what_cannot_be_is_named() -> None:
    (y, u), (_, other) = ordinary_loop(), ordinary_loop(2)
    late, mixed = np.column_stack([u[1:, 0], u[:-1, 1]]), np.column_stack([u[:, 0], other[:, 1]])
    for measurements, commands, words in (
        (u, y, "as if both had been exchanged"),
        (y, u[:, [0, 0]], "one axis was recorded twice"),
        (y[1:], late, "axis 1 follow their measurements 1 frame later than those of axis 0"),
        (y[:, :1], other[:, :1], "they have nothing to do with the measurements"),
        (y, mixed, "those of axis 1 have nothing to do with its measurements"),
        (np.diff(y[:3000, :1], axis=0), u[1:3000, :1], "unstable at any sensor gain"),
    ):
        verdict = explain_commands(record(measurements, commands))
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
    law = lbt.integrator(QUIET["hardware"], gain=0.1).controller
    y, u = run_law(law, frames=6000, **QUIET)
    verdicts = [explain_commands(record(y, factor * u)) for factor in (1.0, 0.1)]
    assert all(verdict.accepted for verdict in verdicts)
    warned = [["as if the commands were too small" in note for note in v.notes] for v in verdicts]
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
        doubts = ["times too small" in words for words in verdict.overruled]
        assert doubts == [True] * bool(options)


def test_the_first_repair_is_none() -> None:
    repairs = list_repairs(2, 2.0)
    assert [repair.options == "" for repair in repairs] == [True] + [False] * (len(repairs) - 1)
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


@pytest.mark.parametrize("fault", ["one turned", "rotated", "a tenth", "late", "increments"])
def test_a_repair_undoes_its_fault(fault) -> None:
    y, u = ordinary_loop()
    repaired = repair_commands(wrong_record(fault), FAULTS[fault][1])
    good = record(y, u)
    start = 1 if fault == "late" else 0  # the measurement of the first frame was lost with it
    usable = np.flatnonzero(repaired.usable)
    assert usable.size > 9980
    c, expected = repaired.corrections(), good.corrections()[start:]
    np.testing.assert_allclose(c[usable], expected[usable], atol=1e-9 * np.max(abs(u)))
    np.testing.assert_array_equal(repaired.measurements[usable], y[start:][usable])


def test_frames_whose_command_is_not_known_are_not_usable() -> None:
    y, u = ordinary_loop()
    seen = record(y, np.where(np.arange(len(u))[:, None] == 5000, np.nan, u))
    later = repair_commands(seen, CommandRepair(shift_frames=3))
    # of three frames of the shift and two of the delay nothing is known
    assert np.flatnonzero(~later.usable).tolist() == [0, 1, 2, 3, 4, 5005]
    summed = repair_commands(seen, CommandRepair(increments=True))
    assert summed.usable[5001]
    assert not summed.usable[5002:].any()  # every later position depends on the lost increment


def test_the_matrix_of_a_repair_is_applied_in_the_order_of_its_fields() -> None:
    both = CommandRepair(swap_axes=True, sign=(1, -1), matrix=(1.0, 2.0, 3.0, 4.0), scale=(2.0,))
    swap, sign = np.array([[0, 1], [1, 0]]), np.diag([1, -1])
    np.testing.assert_allclose(both.turn(2), 2 * np.array([[1, 2], [3, 4]]) @ sign @ swap)
    assert CommandRepair(scale=(500.0, 480.0)).turn(2).tolist() == [[500.0, 0.0], [0.0, 480.0]]
    assert both.options == (
        "--swap-axes --command-sign 1 -1 --command-matrix 1 2 3 4 --command-scale 2"
    )


def test_words_name_what_is_wrong() -> None:
    both = CommandRepair(shift_frames=-2, sign=(1, -1), scale=(1.0, 2.0), delay_frames=3.0)
    assert both.words() == [
        "they are recorded 2 frames late",
        "axis 1 has the opposite sign",
        "the total delay is 3 frames",
        "those of axis 1 are 2 times too small",
    ]


def test_records_and_repairs_that_are_refused() -> None:
    y, u = ordinary_loop()
    one, open_loop = record(y[:, :1], u[:, :1]), record(y)
    three = partial(explain_commands, record(y, u), sensor_gain=[0.6, 0.8, 0.7])

    def repair(seen, **fields):
        return lambda: repair_commands(seen, CommandRepair(**fields))

    rows = [
        (lambda: CommandRepair(sign=(2,)), "command_sign must be 1 or -1"),
        (lambda: CommandRepair(scale=(1.0, -2.0)), "command_scale must be above 0"),
        (lambda: CommandRepair(matrix=(1.0, np.nan, 0.0, 1.0)), "command_matrix"),
        (lambda: CommandRepair(scale=(5.0, 4.0)).turn(1), "command_scale must be one number, or 1"),
        (repair(one, swap_axes=True), "need two axes"),
        (repair(one, sign=(1, -1)), "command_sign must be one number, or 1"),
        (repair(one, matrix=(1.0, 0.0, 0.0, 1.0)), "must have 1 numbers"),
        (repair(open_loop, sign=(-1,)), "open loop"),
        (partial(explain_commands, open_loop), "no commands to explain"),
        (three, "sensor_gain must be one number"),
    ]
    require_refusals((call, lbt.errors.ProblemError, words) for call, words in rows)


def coarse_transforms(series: np.ndarray, frames: int, rate_hz: float) -> tuple:
    segments = coarse_spectrum._segments([(0, frames)], rate_hz)
    return segment_transforms(series, segments, rate_hz, levelled=True)


def axis_of(y: np.ndarray, guesses: np.ndarray) -> tuple:
    """The coarse axis of one measurement (frames,) and guesses (frames, n)."""
    f, z, n = coarse_transforms(np.column_stack([y, guesses]), len(y), RATE)
    return coarse_spectrum.coarse_axis(f, z[0], z[1:], independent=n, frame_rate_hz=RATE)


def test_the_contrast_of_white_noise_lies_between_its_bounds() -> None:
    y = np.random.default_rng(2).standard_normal(24_000)
    bands, peaks, shapes = axis = axis_of(y, 0 * y)
    (contrast,), _ = coarse_spectrum.fit_guesses(axis, np.ones((1, 1)))
    assert np.max(shapes) <= 1
    power, count = bands.measured, bands.count
    rest = np.sum(peaks.count * (np.log(peaks.measured) + 1))
    least = np.sum(count * (np.log(power) + 1)) + rest
    only_noise = np.sum(count) * (np.log(np.average(power, weights=count)) + 1) + rest
    assert least < contrast <= only_noise + 0.1


def test_the_right_correction_is_found_with_its_gain() -> None:
    white, noise = (np.random.default_rng(seed).standard_normal(24_000) for seed in (4, 5))
    slow = lfilter([20], [1, -0.99], white)
    y, u = np.zeros((2, len(white)))
    for k in range(2, len(y)):
        y[k] = 0.6 * (slow[k - 1] - u[k - 2]) + 5 * noise[k]
        u[k] = u[k - 1] + 0.5 * y[k]
    guesses = np.column_stack([np.roll(u, 2), 1e-3 * np.roll(u, 2), np.roll(u, 3), -np.roll(u, 2)])
    starts = np.array([[0.3, 1.0], [300.0, 1000.0], [0.3, 1.0], [0.3, 1.0]])
    contrast, gain = coarse_spectrum.fit_guesses(axis_of(y, guesses), starts)
    assert gain[0] == pytest.approx(0.6, rel=0.1)
    assert gain[1] == pytest.approx(1000 * gain[0], rel=0.01)
    assert contrast[1] == pytest.approx(contrast[0], abs=0.5)
    assert np.all(contrast[2:] > contrast[0] + 100)


def test_slow_loops_have_whole_segments():
    """Six seconds are few frames there, or none: 0.8 may be a rate in kHz."""
    series = np.random.default_rng(0).standard_normal((2000, 1))
    f, z, independent = coarse_transforms(series, 1500, 0.8)
    assert (z.shape, f.size) == ((1, 2, 255), 255)
    density = np.mean(np.abs(z) ** 2)
    assert density == pytest.approx(2 / 0.8, rel=0.1)  # of white noise of variance 1
    assert independent > 1


def test_peaks_are_the_lines_of_a_spectrum():
    frequency, lines = np.arange(1, 2000) / 6, [60, 200]
    power = 1e3 / frequency**2 + 1 + sum(40 / (1 + (frequency - f) ** 2) for f in lines)
    scatter = np.random.default_rng(1).gamma(8.0, 1 / 8.0, frequency.size)
    is_peak, places, width = coarse_spectrum.find_spectral_peaks(frequency, power * scatter)
    assert all(min(abs(places - f)) < 1 for f in lines)
    assert np.all(width > 0)
    assert is_peak[np.searchsorted(frequency, lines)].all()
    assert np.mean(is_peak) < 0.2
