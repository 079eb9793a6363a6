"""Both axes identified with one sensor gain, and records that are not what they seem.

Jumps in a record: found, noted, and cut out; a wrong delay is found out.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from support.eris import ERIS_FILE, eris_example, eris_model, eris_record
from support.recorded_loops import LINE, RATE, integrator_loop, spliced_record

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.fit.both_axes import cut_around
from lbt_synth.identification.records.faults import RecordHealth

FRAMES = 16_384


def joint(
    gains: tuple[float, float], loop_gains: tuple[float, float]
) -> lbt.identification.IdentifiedModel:
    parts = [
        integrator_loop(sensor_gain=g, gain=k, seed=i, frames=20_000, noise=10.0)
        for i, (g, k) in enumerate(zip(gains, loop_gains, strict=True))
    ]
    y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
    u = np.vstack([c, np.zeros((2, 2))])
    record = lbt.identification.loop_record(
        np.vstack([np.zeros((2, 2)), y]), u, frame_rate_hz=RATE, delay_frames=2.0, unit="nm"
    )
    return lbt.identify(record)


def test_axes_share_a_sensor_gain_where_they_agree() -> None:
    same = joint((0.6, 0.6), (0.4, 0.4))
    assert same.axes[0].sensor_gain == same.axes[1].sensor_gain
    assert same.axes[0].sensor_gain_error is not None
    assert same.sensor_gains[0] == pytest.approx(0.6, abs=4 * same.axes[0].sensor_gain_error)
    other = joint((0.9, 0.4), (0.4, 0.4))
    assert other.sensor_gains == pytest.approx((0.9, 0.4), rel=0.1)
    assert "different sensor gains" in other.notes[0]
    one = joint((0.6, 0.6), (0.4, 0.002))
    assert one.axes[1].sensor_gain_note == "that of the other axis"
    assert one.axes[0].sensor_gain == one.axes[1].sensor_gain


def test_a_mean_gain_is_no_better_than_its_axes_agree() -> None:
    """The error of a mean of two is half their difference where that exceeds their errors."""
    model = joint((0.6, 0.65), (0.4, 0.4))
    assert model.sensor_gains[0] == model.sensor_gains[1]
    assert model.axes[0].sensor_gain_error == pytest.approx(0.025, rel=0.15)
    agreed = joint((0.6, 0.6), (0.4, 0.4))
    assert agreed.axes[0].sensor_gain_error < 0.013


def test_identify_needs_what_it_needs() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 1))
    without = lbt.identification.loop_record(y, y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(ProblemError, match="give delay_frames"):
        lbt.identify(without)
    with pytest.raises(ProblemError, match="one number, or one per measurement \\(1\\)"):
        lbt.identify(
            lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm"), sensor_gain=[1.0, 2.0]
        )
    with pytest.raises(ProblemError, match="expected an IdentifiedModel"):
        lbt.report.figures.identification_figure("model")


def with_commands_of_size(
    record: lbt.identification.LoopRecord, factor: float
) -> lbt.identification.LoopRecord:
    assert record.commands is not None
    return replace(record, commands=factor * record.commands)


@pytest.mark.parametrize("factor", [1 / 500, 100.0])
def test_commands_in_other_units_are_doubted(factor: float) -> None:
    record = spliced_record((0,), lines=LINE, frames=20_000)
    found = lbt.identify(with_commands_of_size(record, factor))
    doubted = any("units, signs and axes of the commands" in note for note in found.notes)
    assert doubted or found.axes[0].sensor_gain_error is None


@pytest.mark.parametrize(("factor", "doubted"), [(0.5, True), (0.7, False), (1.0, False)])
def test_a_gain_above_one_is_named_as_commands_of_part_size(factor: float, doubted: bool) -> None:
    record = spliced_record((0,), lines=LINE, frames=40_000)
    found = lbt.identify(with_commands_of_size(record, factor))
    assert found.axes[0].sensor_gain == pytest.approx(0.6 / factor, rel=0.05)
    assert any("--command-scale 2" in note for note in found.notes) == doubted


def test_wide_resonances_that_hide_the_gain_are_noted() -> None:
    lines = ((20.0, 0.1, 60.0), (60.0, 0.3, 40.0), (130.0, 0.5, 40.0))
    axis = lbt.identify(spliced_record((1,), lines=lines, frames=60_000, noise=8.0)).axes[0]
    if axis.sensor_gain_error is None:
        assert "not found" in axis.sensor_gain_note
    else:
        assert axis.sensor_gain == pytest.approx(0.6, abs=3 * axis.sensor_gain_error)


def test_innovations_that_are_not_white_are_noted() -> None:
    record = spliced_record(lines=((40, 0.01, 30.0),), frames=8192)
    for most_lines, count in ((0, 1), (5, 0)):
        model = lbt.identify(record, sensor_gain=0.6, most_lines=most_lines)
        notes = [note for note in model.notes if "are not white" in note]
        assert len(notes) == count
        assert all("standard errors do not cover" in note for note in notes)


def test_a_wide_resonance_is_no_turbulence() -> None:
    axis = lbt.identify(spliced_record((1,), lines=((60.0, 0.3, 30.0),), frames=60_000)).axes[0]
    assert axis.turbulence_fit.frequency_hz < 3
    assert axis.turbulence.rms_nm == pytest.approx(300, rel=0.3)
    (part,) = axis.parts
    assert part.kind == "broad"
    assert part.frequency_hz == pytest.approx(60, rel=0.1)


def test_standard_errors_hold_the_error_of_the_gain() -> None:
    deviations = []
    for seed in range(10):
        parts = [
            integrator_loop(lines=((31, 0.05, 60),), gain=0.15, seed=10 * seed + i, frames=15_000)
            for i in range(2)
        ]
        y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
        record = lbt.identification.loop_record(
            y[:-2], np.vstack([c[2:], c[-2:]])[:-2], frame_rate_hz=RATE, delay_frames=2, unit="nm"
        )
        model = lbt.identify(record)
        alone = lbt.identification.identify_axis(
            y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=model.sensor_gains[0]
        )
        deviations += [
            (axis.lines[0].rms_nm - 60) / axis.lines[0].rms_error_nm
            for axis in model.axes
            if axis.lines
        ]
        # a gain that is given without an error makes them smaller
        assert model.axes[0].lines[0].rms_error_nm > alone.lines[0].rms_error_nm
    assert 0.5 < np.sqrt(np.mean(np.square(deviations))) < 1.6


def test_the_limit_of_lines_is_kept_and_noted() -> None:
    lines = tuple((10.0 + 12 * i, 0.004, 30.0) for i in range(8))
    record = spliced_record(lines=lines, frames=20_000)
    found = lbt.identify(record, most_lines=5, sensor_gain=0.6)
    assert sum(part.kind != "turbulence" for part in found.axes[0].parts) <= 5
    assert any("limit of 5 lines was reached" in note for note in found.notes)
    assert not any("limit" in note for note in lbt.identify(record, sensor_gain=0.6).notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensor_gain": 1e300}, "sensor_gain must be"),
        ({"sensor_gain": "x"}, "sensor_gain must be an array of numbers"),
        ({"announced": [31.0]}, "LinePrior"),
        ({"start": 3}, "IdentifiedModel"),
        ({"stretches": [(2, 4000), (3000, 5000)]}, "in order, apart"),
        ({"stretches": [(0, 4000)]}, "usable"),
        ({"frame_rate_hz": 900.0}, "for spectra only"),
        ({"delay_frames": 3.0}, "with_delay"),
    ],
)
def test_bad_requests(options: dict[str, object], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        lbt.identify(spliced_record(frames=6000), **options)  # type: ignore[arg-type]


def test_a_dead_axis_is_named() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 2))
    y[:, 1] = 0
    record = lbt.identification.LoopRecord(
        frame_rate_hz=RATE,
        measurements=y,
        usable=np.ones(6000, dtype=bool),
        health=RecordHealth(frames=6000, usable=6000),
    )
    with pytest.raises(ProblemError, match="axis 1 of the record is constant"):
        lbt.identify(record)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return eris_example()


@pytest.fixture(scope="module")
def seen() -> lbt.identification.SpectrumRecord:
    return eris_record()


@pytest.fixture(scope="module")
def model() -> lbt.identification.IdentifiedModel:
    return eris_model()


def test_spectrum_without_scatter_is_taken_for_one_periodogram(example):
    plain = lbt.load_record(ERIS_FILE, kind="spectrum", unit="nm^2/Hz")
    found = lbt.identify(plain, frame_rate_hz=1000)
    assert len(found.notes) == 2
    assert all("does not scatter" in note for note in found.notes)
    for column, axis in zip(plain.density_nm2_hz.T, found.axes, strict=True):
        assert axis.data.count[0] == 1
        assert len(axis.lines) >= 8
        peaks = np.array(example.peaks(plain.frequency_hz, column))[:, 0]
        assert all(np.min(np.abs(peaks - line.frequency_hz)) < 0.06 for line in axis.lines)
        assert all(line.rms_nm < 30 for line in axis.lines)  # 332 where it counts as a million


@pytest.mark.parametrize(
    "option", [{"sensor_gain": 0.5}, {"stretches": [(0, 600)]}, {"start": "model"}]
)
def test_a_spectrum_takes_no_options_of_series(option, model):
    plain = lbt.load_record(ERIS_FILE, kind="spectrum", unit="nm^2/Hz")
    given = {"start": model} if "start" in option else option
    with pytest.raises(lbt.errors.ProblemError, match="is for series of a loop"):
        lbt.identify(plain, frame_rate_hz=1000, **given)


def test_known_lines_are_found(model):
    for axis, known in zip(
        model.axes,
        ([10, 16, 25.8, 45.5, 48.3, 96.7], [10, 16, 45.5, 48.3, 72.5, 96.7]),
        strict=True,
    ):
        places = np.array([line.frequency_hz for line in axis.lines])
        for frequency in known:
            assert np.min(np.abs(places - frequency)) < 0.06
    assert not model.notes


def test_identified_rms_are_those_of_the_bins(model, seen, example):
    strong = 0
    for i, axis in enumerate(model.axes):
        peaks = np.array(example.peaks(seen.frequency_hz, seen.density_nm2_hz[:, i]))
        for line in axis.lines:
            near = peaks[np.abs(peaks[:, 0] - line.frequency_hz) < 0.08]
            size = np.sqrt(np.sum(near[:, 1] ** 2))
            assert size > 0  # none is where the file has nothing
            assert 0.4 * size < line.rms_nm < 1.4 * size
            assert 0 < line.rms_error_nm < line.rms_nm
            strong += abs(line.rms_nm - size) < 2 * line.rms_error_nm
    assert strong >= 17  # of 22


def test_kalman_removes_what_the_integrator_leaves_of_the_lines(model, seen, example):
    met, plant = example.disturbance(seen), example.composed(model)
    lines = {}
    for name, design in {
        "integrator": lbt.design.model_integrator(plant),
        "Kalman": lbt.kalman(plant),
    }.items():
        assert design.certificate.passed
        loop = lbt.close_loop(plant.hardware, design.controller)
        parts = example.residual(loop, met)
        lines[name] = example.rms(parts["lines"])
        # bin by bin, without quadrature
        f, step = seen.frequency_hz, np.median(np.diff(seen.frequency_hz))
        excess = np.array([part.psd(f) for part in met.lines]).T
        power = np.einsum("fij,fj->", np.abs(loop.sensitivity(f)) ** 2, excess) * step
        assert lines[name] == pytest.approx(np.sqrt(power), rel=0.16)
        assert example.rms(parts["total"]) ** 2 == pytest.approx(
            sum(example.rms(parts[key]) ** 2 for key in parts if key != "total")
        )
        limit = lbt.loop.least_residual(plant.hardware, met.whole)
        assert limit.rms_nm < example.rms(parts["total"])
    assert lines["Kalman"] < 0.3 * lines["integrator"]


def test_turbulence_of_the_plant_is_the_atmospheres(model, example):
    plant = example.composed(model)
    air = lbt.models.ar2_turbulence(example.AIR, frame_rate_hz=1000, noise_nm=example.NOISE_NM)
    made = plant.vibrations[0].ar_model(1000)
    assert made.coefficients == pytest.approx(air.coefficients, rel=1e-9)
    assert made.rms_nm == pytest.approx(air.rms_nm, rel=1e-9)


def test_a_printed_model_lists_its_vibrations_with_their_errors(model):
    shown = [line.split() for line in str(model).splitlines()]
    for part in model.parts:
        rows = [row for row in shown if f"{part.frequency_hz:.3f}" in row]
        assert any(f"{part.frequency_error_hz:.2g}" in row for row in rows)
        assert any(f"{part.rms_nm:.2f}" in row for row in rows)
    assert len(repr(model)) <= 100
    assert len(repr(model.axes[0])) <= 100


def test_a_jump_is_found_noted_and_cut() -> None:
    clean = lbt.identify(spliced_record(lines=LINE, frames=20_000))
    spliced = spliced_record((0, 1), lines=LINE, frames=20_000)
    found = lbt.identify(spliced)
    assert not clean.notes
    assert all(note.startswith("warning: 1 jump of the") for note in found.notes)
    assert "the record was cut there" in found.notes[0]
    axis = found.axes[0]
    assert axis.sensor_gain_error is not None
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.noise_nm == pytest.approx(6, abs=4 * axis.noise_error_nm)


@pytest.mark.parametrize("lost", [(5008, 6154), (3000, 4500), (7000, 9900), (2000, 9000)])
def test_frames_that_were_lost_do_not_move_the_gain(lost: tuple[int, int]) -> None:
    whole = spliced_record((3,), lines=LINE, frames=20_000)
    y, u = (
        np.vstack([series[: lost[0]], series[lost[1] :]])
        for series in (whole.measurements, whole.commands)
    )
    spliced = lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    found = lbt.identify(spliced)
    axis = found.axes[0]
    assert axis.sensor_gain_error is not None
    assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
    assert axis.sensor_gain_error < 0.05
    assert any("jump" in note for note in found.notes)


def test_stretches_are_cut() -> None:
    assert cut_around(((0, 100), (200, 300)), [50, 200]) == ((0, 47), (53, 100), (203, 300))
    assert cut_around(((0, 4),), [1]) == ()
