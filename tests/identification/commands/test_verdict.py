"""The verdict on commands: faults are named with what repairs them, good records pass."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.control_laws import TRUTH, SteppedLaw, ordinary_loop, run_law
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

# lines (Hz, damping, nm, direction)
_LINES = {
    46: """54.644241 0.0057555 99.197964 2.62514  85.627632 0.00237002 97.318496 2.59532
        138.10218 0.00760899 67.016067 2.13911  14.338187 0.00696344 62.747013 0.691667
        46.265706 0.00300496 94.616029 2.62616""",
    198: """59.77816 0.00922046 26.618522 3.03506  147.00317 0.00861081 59.089946 1.09802
        45.176974 0.00286793 79.169178 1.63632  113.71687 0.00354196 80.716156 1.005
        88.666623 0.00215286 97.423308 0.092637""",
}
_LOOPS = {  # coefficients and drive of the turbulence; noise [nm], sensor gain, integrator gain
    46: ([1.99939396, -0.999395551], 0.019264654, 2.406247, 0.4560861, 0.20877578),
    198: ([1.99180077, -0.991819641], 0.33053314, 4.082686, 0.8558551, 0.40405704),
}


@cache
def hidden_gain_loop(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and commands of 30 s."""
    coefficients, drive, noise_nm, sensor_gain, gain = _LOOPS[seed]
    turbulence = lbt.models.ARModel(
        coefficients=coefficients, driving_rms_nm=drive, frame_rate_hz=RATE
    )
    lines = [
        lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=rms, direction=(np.cos(a), np.sin(a)))
        for f, damping, rms, a in np.reshape(_LINES[seed].split(), (-1, 4)).astype(float)
    ]
    truth = lbt.Truth(
        turbulence=turbulence, vibrations=lines, noise_nm=noise_nm, sensor_gain=sensor_gain
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    law = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(law, truth, hardware=path, frames=31_000, seed=seed, frame_means=True)
    return run.measurements[0, 1000:], run.commands[0, 1000:]


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
    truth = lbt.Truth(turbulence=TRUTH.turbulence, noise_nm=8.0, sensor_gain=0.7)
    run = lbt.simulate(law, truth, hardware=path, frames=10_000)
    verdict = explain_commands(record(run.measurements[0], run.commands[0]))
    assert verdict.accepted
    assert verdict.law.lag_frames == 1
    assert "the total delay of a new design is 3 frames" in verdict.notes[0]


def test_a_law_may_couple_the_axes_on_purpose() -> None:
    y, u = run_law(SteppedLaw([[0.4, 0.1], [-0.1, 0.3]]))
    assert explain_commands(record(y, u)).accepted


@pytest.mark.parametrize(
    ("seed", "fault"),
    [
        (46, "turned"),  # a scale of 1e10 was named
        (198, "late"),  # as given is likelier by 1700
    ],
)
def test_the_law_decides_where_crowded_lines_mislead_a_coarse_spectrum(seed, fault) -> None:
    spoil, repair = FAULTS[fault]
    verdict = explain_commands(record(*spoil(*hidden_gain_loop(seed))))
    assert verdict.repair.options == repair.options


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


def axis_late(y, u):
    return y[1:], np.column_stack([u[1:, 0], u[:-1, 1]])


def of_another_night(y, u):
    return y, np.column_stack([u[:, 0], ordinary_loop(5)[1][:, 1]])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda y, u: (u, y), "as if both had been exchanged"),
        (lambda y, u: (y, u[:, [0, 0]]), "one axis was recorded twice"),
        (axis_late, "those of axis 1 follow their measurements 1 frame later than those of axis 0"),
        (
            lambda y, u: (y[:, :1], ordinary_loop(2)[1][:, :1]),
            "they have nothing to do with the measurements",
        ),
        (of_another_night, "those of axis 1 have nothing to do with its measurements"),
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


@pytest.mark.parametrize(
    ("gains", "errors", "options"),
    [
        ([1.6, 1.62], [0.02, 0.02], "--command-scale 2"),
        ([700.0], [5.0], "--command-scale 1000"),
        ([1.6, 1.62], [0.1, 0.1], ""),
        ([1.6, 0.8], [0.02, 0.02], ""),  # not the unit: the axes differ
        ([0.1, 0.1], [0.001, 0.001], ""),
    ],
)
def test_gains_far_above_plausible_ones_are_another_unit(gains, errors, options):
    verdict = judge_fitted_gains(np.array(gains), np.array(errors))
    assert (verdict.repair.options, verdict.accepted) == (options, not options)
    assert [("times too small" in words) for words in verdict.overruled] == [True] * bool(options)


def test_the_first_repair_is_none() -> None:
    repairs = list_repairs(2, 2.0)
    assert [repair.options for repair in repairs].index("") == 0
    assert {repair.options for repair in repairs[1:]}.isdisjoint({""})
    for lag, least in ((0, -1), (2, -3), (5, -5)):  # a total delay of one frame is the least
        shifts = [repair.shift_frames for repair in list_repairs(2, 2.0, lag=lag)]
        assert (min(shifts), max(shifts)) == (least, 3)


def test_units_are_powers_of_ten_however_coarse_the_gain() -> None:
    implausible = np.zeros(2, dtype=bool)
    for factor in (1e-9, 1e3):
        for gain in (0.3, 1.64):
            gains = factor * gain * np.array([0.9, 1.1])
            np.testing.assert_allclose(likely_factors(gains, implausible), [factor] * 2)


def test_one_factor_stands_for_the_axes_whose_gains_are_not_plausible() -> None:
    """Gains of 6 and 13 were named 10 and 100 times too large for their units."""
    for gains, factors in (([6.0, 13.0], [10.0, 10.0]), ([0.8, 1.6], [1.0, 2.0])):
        within = (np.array(gains) >= 0.2) & (np.array(gains) <= 1.25)
        assert likely_factors(np.array(gains), within).tolist() == factors


@pytest.mark.parametrize(
    ("factor", "options"),
    [
        (1.0, ""),
        pytest.param(0.1, "--command-scale 10", marks=pytest.mark.study),
        (1e3, "--command-scale 0.001"),
    ],
)
def test_wide_resonances_hide_no_other_unit(factor: float, options: str) -> None:
    """The coarse gain is twice the true one here: a factor of two is left to the fit."""
    record = resonant_record()
    record = replace(record, commands=factor * record.commands)
    assert explain_commands(record).repair.options == options


def test_a_known_gain_holds_after_a_repair() -> None:
    """By its spectrum another delay was likelier, at which one axis had a seventh of the gain."""
    seen = structure(138).record(0, 10_000)
    assert explain_commands(seen, sensor_gain=[1.0]).doubt == ""
