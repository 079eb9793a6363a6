"""Commands of records: their law, faults and repairs, coarse spectra, and the verdict."""

import re
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.signal import lfilter
from support.plants import lbt_axis_plant
from support.recorded_loops import LINE, RATE, resonant_record, slow, spliced_record
from support.refusals import refused, require_refusals
from support.structures import structure

import lbt_synth as lbt
from lbt_synth.identification import LoopRecord, loop_record
from lbt_synth.identification.commands import coarse_spectrum
from lbt_synth.identification.commands.control_law import (
    classify_matrix,
    fit_control_law,
    law_controller,
)
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
from lbt_synth.identification.commands.verdict import (
    AS_GIVEN,
    CommandVerdict,
    explain_commands,
    judge_fitted_gains,
    likely_factors,
    list_repairs,
)
from lbt_synth.identification.fit.periodogram import segment_transforms

PATH = lbt.LoopHardware(frame_rate_hz=RATE)
SHAKEN = lbt.Vibration(frequency_hz=31, damping=0.005, rms_nm=60, direction=(1.0, 0.5))
TRUTH = lbt.Truth(turbulence=slow(), vibrations=(SHAKEN,), noise_nm=8.0, sensor_gain=0.7)


@dataclass
class SteppedLaw:
    """``v(k) = leak v(k-1) + gain y(k)`` of two axes, integrated again, clipped and disturbed."""

    gain: object
    leak: float = 1.0
    again: float | None = None
    limit_nm: float = np.inf
    wind_up: bool = False
    dither_nm: float = 0.0

    def reset(self):
        self.command, self.sum = np.zeros(2), np.zeros(2)
        self.random = np.random.default_rng(5)

    def step(self, y):
        move = np.dot(self.gain, y) + self.dither_nm * self.random.standard_normal(2)
        if self.again is not None:
            self.sum = self.sum + self.again * move
            move = move + self.sum
        command = self.leak * self.command + move
        applied = np.clip(command, -self.limit_nm, self.limit_nm)
        self.command = command if self.wind_up else applied
        return applied.copy()


def run_law(controller, *, frames=3000, seed=1, truth=TRUTH, hardware=PATH):
    """Measurements and commands of a loop, (frames, 2) each."""
    options = {"frames": frames, "seed": seed, "frame_means": True}
    run = lbt.simulate(controller, truth, hardware=hardware, **options)
    return run.measurements[0], run.commands[0]


@cache
def ordinary_loop(seed=1):
    """Measurements and commands of an integrator with gains of 0.4 and 0.3."""
    law = lbt.Controller(A=np.eye(2), B=RAN, C=np.eye(2), D=0 * RAN, dt_s=1 / RATE)
    return run_law(law, seed=seed, frames=10_000)


RAN = np.diag([0.4, 0.3])
TURN = np.array([[np.sqrt(3), -1], [1, np.sqrt(3)]]) / 2  # by 30 degrees
SWAP = np.array([[0.0, 1.0], [1.0, 0.0]])


def law_of(y, u, usable=None):
    """The law of a record whose frames are all good, unless it is said."""
    good = np.ones(len(y), dtype=bool) if usable is None else usable
    marks = {"measured": good, "commanded": good}
    return fit_control_law(LoopRecord(frame_rate_hz=RATE, measurements=y, commands=u, **marks))


@pytest.mark.parametrize(
    ("change", "structure", "signs", "late"),
    [
        (np.eye(2), "diagonal", (1, 1), -1),
        (-np.eye(2), "diagonal", (-1, -1), -4),
        (-SWAP, "swapped", (-1, -1), 2),
        (TURN, "general", (0, 0), 0),
        (np.array([[1.0, 0.9], [0.3, 0.6]]), "general", (0, 0), 4),
    ],
)
def test_commands_by_a_matrix_that_are_shifted(change, structure, signs, late):
    y, u = ordinary_loop()
    law = law_of(y[5:-5], np.roll(u @ change.T, late, axis=0)[5:-5])
    assert (law.kind, law.lag_frames, law.order) == ("integrator", late, 1)
    np.testing.assert_allclose(law.gain, change @ RAN, atol=1e-9 * np.abs(change).max())
    assert classify_matrix(law.gain) == (structure, signs)
    np.testing.assert_allclose(law.poles, 1.0, atol=1e-9)
    assert law.exact
    assert np.mean(law.axis_coherence) > 1 - 1e-6


def test_increments_in_place_of_positions():
    y, u = ordinary_loop()
    law = law_of(y[1:], np.diff(u, axis=0))
    assert (law.kind, law.order, law.lag_frames, law.poles.size) == ("proportional", 0, 0, 0)
    np.testing.assert_allclose(law.gain, RAN, atol=1e-9)


def test_commands_of_another_night_have_no_law():
    y, u = ordinary_loop()
    _, other = ordinary_loop(seed=2)
    for measurements, commands in (
        (y, other),
        (y[1000:], u[:-1000]),  # the same night, a second later
        (y, np.zeros_like(u)),
    ):
        law = law_of(measurements, commands)
        assert law.kind == "none"
        assert np.mean(law.axis_coherence) < 0.02
        assert law.axes_kind == "zero"
        assert not law.exact
    assert law_of(y[:300], u[:300]) is None  # it is too short
    assert law_of(y, None) is None


@pytest.mark.parametrize(
    ("controller", "kind", "poles", "gain"),
    [
        (SteppedLaw(0.4, leak=0.99), "integrator", [0.99], 0.4 * np.eye(2)),
        (SteppedLaw(0.3, again=0.02), "double integrator", [1.0, 1.0], 0.006 * np.eye(2)),
        (SteppedLaw(0.4, limit_nm=300, wind_up=True), "integrator", [1.0], 0.4 * np.eye(2)),
    ],
)
def test_laws_of_low_order(controller, kind, poles, gain):
    law = law_of(*run_law(controller))
    assert (law.kind, law.lag_frames) == (kind, 0)
    np.testing.assert_allclose(law.poles, [poles, poles], atol=1e-5)
    np.testing.assert_allclose(law.gain, gain, atol=1e-6)
    assert law.exact


def test_the_law_of_a_filter_is_that_of_its_design():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    known = {"turbulence": plant.turbulence, "vibrations": plant.vibrations, "noise_nm": 15.5}
    truth = lbt.Truth(**known, sensor_gain=1.0)
    law = law_of(*run_law(controller, truth=truth, hardware=plant.hardware))
    assert (law.kind, law.lag_frames, law.exact) == ("higher order", 0, True)
    rate_hz = plant.hardware.frame_rate_hz
    frequencies_hz = rate_hz * np.array([0.001, 0.01, 0.025, 0.1, 0.3])
    again, exact = (
        one.to_statespace().frequency_response(frequencies_hz)[:, 0, 0]
        for one in (law_controller(law, rate_hz), controller)
    )
    np.testing.assert_allclose(again, exact, rtol=1e-4)


def test_coarse_commands_and_those_in_single_precision():
    y, u = ordinary_loop()
    coarse = law_of(y, 3.0 * np.round(u / 3.0))
    assert (coarse.kind, coarse.lag_frames, coarse.axes_kind) == ("integrator", 0, "diagonal")
    np.testing.assert_allclose(coarse.gain, RAN, atol=0.005)
    # two roundings of variance 9/12, of the increments' variance
    rounding = np.mean(1.5 / np.var(np.diff(u, axis=0), axis=0))
    assert coarse.residual == pytest.approx(rounding, rel=0.1)
    single = law_of(y.astype(np.float32), (u + 1e4).astype(np.float32))
    assert (single.kind, single.exact) == ("integrator", True)


def test_a_loop_that_is_shaken_by_its_commands_is_not_read_backwards():
    law = law_of(*run_law(SteppedLaw(0.4, dither_nm=20.0), frames=6000))
    assert law.lag_frames == 0
    assert law.residual > 0.5
    np.testing.assert_allclose(law.gain, 0.4 * np.eye(2), atol=0.02)


def test_frames_that_follow_no_law():
    y, u = ordinary_loop()
    usable = np.random.default_rng(0).random(len(y)) > 0.01
    marked = usable[:, None]
    holes = law_of(np.where(marked, y, 0.0), np.where(marked, u, 1e5), usable=usable)
    frame = np.arange(len(y))[:, None]
    y = np.where(frame % 500 == 0, 0.0, y)  # spoilt, and not said
    u = np.where(frame < 5000, u, u - 4000.0)  # an offload
    spoilt = law_of(np.delete(y, 7777, axis=0), np.delete(u, 7777, axis=0))
    for law in (holes, spoilt):
        assert law.kind == "integrator"
        np.testing.assert_allclose(law.gain, RAN, atol=1e-9)


def test_one_axis_without_a_law():
    y, u = ordinary_loop()
    law = law_of(y + [0, 100] * np.random.default_rng(0).standard_normal(y.shape), u)
    assert law.lag_frames == 0
    assert law.axis_coherence[0] > 0.999 > 0.1 > law.axis_coherence[1]
    assert law.gain[0, 0] == pytest.approx(0.4)


def test_small_elements_count_as_zero():
    assert classify_matrix([[0.4, 0.03], [-0.03, 0.4]])[0] == "general"
    assert classify_matrix([[0.4, 0.015], [-0.015, 0.4]])[0] == "diagonal"
    assert classify_matrix(np.zeros((2, 2))) == ("zero", (0, 0))


def test_it_repeats_the_commands():
    y, u = run_law(SteppedLaw([[0.3, 0.1], [0.0, 0.2]], leak=0.98))
    late = np.roll(u, 2, axis=0)
    law = law_of(y, late)
    assert law.lag_text == ", 2 frames late"
    run = law_controller(law, RATE).start()
    replayed = np.array([run.step(row) for row in y])
    # what the command was before the record has decayed
    np.testing.assert_allclose(replayed[-500:], late[-500:], atol=1e-6)


CROWDED = """59.77816 0.00922046 26.618522 3.03506  147.00317 0.00861081 59.089946 1.09802
    45.176974 0.00286793 79.169178 1.63632  113.71687 0.00354196 80.716156 1.005
    88.666623 0.00215286 97.423308 0.092637"""  # lines: Hz, damping, nm, direction
record = partial(loop_record, frame_rate_hz=RATE, delay_frames=2.0, unit="nm")
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
ONE_AXIS = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
QUIET = {"truth": replace(TRUTH, vibrations=()), "hardware": ONE_AXIS}


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


@pytest.mark.parametrize(("telescope", "method"), [("vlt", "kalman"), ("keck", "hinf")])
def test_the_records_of_long_laws_are_sound(tmp_path, telescope, method) -> None:
    """Weights add up to nothing with poles near 1; a gain is hidden on one axis alone."""
    path = tmp_path / "loop.yaml"
    path.write_text(lbt.config.telescope_template(telescope))
    config = lbt.load_config(path)
    law = config.design(method).controller
    y, u = run_law(law, truth=config.truth, hardware=config.hardware, frames=8000, seed=0)
    loop = config.hardware
    known = {"frame_rate_hz": loop.frame_rate_hz, "delay_frames": loop.delay_frames, "unit": "nm"}
    assert explain_commands(loop_record(y, u, **known)).explanation == AS_GIVEN
    twice = explain_commands(loop_record(y, u[:, [0, 0]], **known))
    assert "one axis was recorded twice" in twice.explanation


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_repaired(fault) -> None:
    wrong = wrong_record(fault)
    verdict = explain_commands(wrong)
    assert verdict.repair.options == FAULTS[fault][1].options
    error = refused(verdict.require_accepted, lbt.errors.RecordError, verdict.explanation[:20])
    assert error.options == verdict.repair.options
    assert verdict.explanation in verdict.overruled[0]
    if fault == "turned":
        seen = replace(wrong, read_with="--command-sign -1")
        assert explain_commands(seen).advice == "leave --command-sign -1 out"
        assert explain_commands(repair_commands(wrong, verdict.repair)).accepted


@pytest.mark.parametrize(
    ("read_with", "repair", "advice"),
    [
        ("--command-sign -1", CommandRepair(sign=(-1,)), "leave {} out"),
        ("--command-matrix 0 1 1 0", CommandRepair(swap_axes=True), "leave {} out"),
        ("--command-increments", CommandRepair(delay_frames=1.0), "leave {} out"),
        ("--swap-axes", CommandRepair(), "leave {} out"),
        ("--swap-axes", CommandRepair(sign=(-1,)), "read the record with {} --command-sign -1"),
    ],
)
def test_the_advice_knows_the_options_that_were_given(read_with, repair, advice) -> None:
    verdict = CommandVerdict(
        explanation="wrong", repair=repair, gain=np.ones(2), law=None, read_with=read_with
    )
    assert verdict.advice == advice.format(read_with)
    error = refused(verdict.require_accepted, lbt.errors.RecordError, "wrong")
    assert read_with in error.at_terminal
    assert ("Leave" in error.at_terminal) == ("leave" in advice)


def test_records_that_are_accepted_with_a_note() -> None:
    """Laws may use old measurements and couple the axes, and ten strong seconds tell a delay."""
    y, u = ordinary_loop()
    torn = np.where(np.arange(len(y))[:, None] % 400 == 0, np.nan, y)
    weak = spliced_record(lines=LINE, frames=8000, gain=0.03)
    slow = lbt.Controller(
        A=[[1.0, 0.3], [0.0, 0.0]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.0]], dt_s=1 / RATE
    )
    coupled = SteppedLaw([[0.4, 0.1], [-0.1, 0.3]])
    open_delay = "delay open: 1 or 3 explain it as well as the 2 frames that are given and taken"
    delay = "1 frame earlier. If the real-time computer takes that long, the total delay .* is 3 fr"
    for seen, words in (
        (weak, open_delay),
        (record(*run_law(slow, frames=10_000, **QUIET)), delay),
        (record(torn, u), "not tested"),
        (record(*run_law(coupled)), ""),
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
    short = explain_commands(spliced_record((2,), lines=LINE, frames=10_000).with_delay(2.5))
    assert short.repair == repair  # a whole frame that is not a whole frame from the delay given
    assert short.explanation.endswith("and a delay of 1.5 frames explains the record as well")


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
    law = lbt.integrator(ONE_AXIS, gain=0.1).controller
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
        (partial(law_controller, law_of(y, 0 * u), RATE), "a law that can run; got no law"),
        (partial(law_controller, law_of(y[:-2], u[2:]), RATE), "can run; got .*, 2 frames early"),
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
