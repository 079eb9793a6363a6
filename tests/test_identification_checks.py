"""What an identification says of records that are not what they seem."""

from __future__ import annotations

import time

import numpy as np
import pytest
from test_cli import run
from test_identification import RATE, loop_of

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.fit.jumps import cut_around
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.whiteness import whiteness


def record_of(
    seeds: tuple[int, ...] = (0,), *, delay: float = 2.0, **options
) -> lbt.identification.LoopRecord:
    """Records of one axis, end to end."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    series = []
    for seed in seeds:
        y, c = loop_of(seed=seed, **options)
        u = np.vstack([c[2:], c[-2:]])  # c(k) = u(k-2)
        series.append((y[:-2], u[:-2]))
    y, u = (np.vstack([one[i] for one in series]) for i in range(2))
    assert path.delay_frames == 2
    return lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=delay, unit="nm")


LINE = ((31.0, 0.004, 60.0),)


def test_a_jump_is_found_cut_and_told() -> None:
    clean = lbt.identify(record_of(lines=LINE, frames=20_000))
    spliced = record_of((0, 1), lines=LINE, frames=20_000)
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
    whole = record_of((3,), lines=LINE, frames=20_000)
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


@pytest.mark.parametrize("factor", [1 / 500, 100.0])
def test_commands_in_other_units_are_doubted(factor: float) -> None:
    record = record_of((0,), lines=LINE, frames=20_000)
    wrong = lbt.identification.loop_record(
        record.measurements,
        factor * record.commands,
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    found = lbt.identify(wrong)
    told = any("units, signs and axes of the commands" in note for note in found.notes)
    assert told or found.axes[0].sensor_gain_error is None


def test_stretches_are_cut() -> None:
    assert cut_around([(0, 100), (200, 300)], [50, 200]) == [(0, 47), (53, 100), (203, 300)]
    assert cut_around([(0, 4)], [1]) == []


@pytest.mark.parametrize("told", [1.0, 2.5, 3.0])
def test_a_wrong_delay_is_told(told: float) -> None:
    record = record_of(lines=LINE, frames=30_000).with_delay(told)
    found = lbt.identify(record)
    better = [note for note in found.notes if "fits better than" in note]
    if told != 2.5:
        assert f"a delay of 2 frames fits better than {told:g}" in better[0]
    assert found.notes or not found.axes[0].whiteness.white


def test_wide_resonances_that_hide_the_gain_are_told() -> None:
    lines = ((20.0, 0.1, 60.0), (60.0, 0.3, 40.0), (130.0, 0.5, 40.0))
    axis = lbt.identify(record_of((1,), lines=lines, frames=60_000, noise=8.0)).axes[0]
    if axis.sensor_gain_error is None:
        assert "not found" in axis.sensor_gain_note
    else:
        assert axis.sensor_gain == pytest.approx(0.6, abs=3 * axis.sensor_gain_error)


def test_a_wide_resonance_is_no_turbulence() -> None:
    axis = lbt.identify(record_of((1,), lines=((60.0, 0.3, 30.0),), frames=60_000)).axes[0]
    assert axis.turbulence_fit.frequency_hz < 3
    assert axis.turbulence.rms_nm == pytest.approx(300, rel=0.3)
    (part,) = axis.parts
    assert part.kind == "broad"
    assert part.frequency_hz == pytest.approx(60, rel=0.1)


def test_standard_errors_hold_the_error_of_the_gain() -> None:
    deviations = []
    for seed in range(10):
        parts = [
            loop_of(lines=((31, 0.05, 60),), gain=0.15, seed=10 * seed + i, frames=15_000)
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


def test_the_number_of_lines_is_kept_and_its_limit_told() -> None:
    lines = tuple((10.0 + 12 * i, 0.004, 30.0) for i in range(8))
    record = record_of(lines=lines, frames=20_000)
    found = lbt.identify(record, most_lines=5, sensor_gain=0.6)
    assert sum(part.kind != "turbulence" for part in found.axes[0].parts) <= 5
    assert any("limit of 5 lines was reached" in note for note in found.notes)
    assert not any("limit" in note for note in lbt.identify(record, sensor_gain=0.6).notes)


def test_whiteness_of_white_noise_in_segments() -> None:
    rng = np.random.default_rng(0)
    for pieces in ([(0, 8192)], [(i * 1024, (i + 1) * 1024) for i in range(4)]):
        p_values = []
        for _ in range(120):
            white = rng.standard_normal(8192)
            data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=pieces)
            model = np.full(data.frequency_hz.size, 2 / RATE)
            test = whiteness(data, data.power(1.0), model)
            p_values.append((test.p_value, test.correlation_p_value))
        # 120 trials: at most 6 below 1 %, and 16 below 5 %, with a probability of 0.999
        assert np.all(np.sum(np.array(p_values) < 0.01, axis=0) <= 6)
        assert np.all(np.sum(np.array(p_values) < 0.05, axis=0) <= 16)


def test_a_sinusoid_without_noise_is_no_crash(tmp_path, capsys) -> None:
    series = 100 * np.sin(2 * np.pi * 0.05 * np.arange(8192))
    np.save(tmp_path / "s.npy", series)
    begin = time.process_time()
    status, _, error = run(
        capsys,
        "identify",
        tmp_path / "s.npy",
        "--kind",
        "open-loop",
        "--unit",
        "nm",
        "--frame-rate-hz",
        1000,
        "-o",
        tmp_path / "s.yaml",
        "--no-figure",
    )
    assert status in (0, 2)
    assert "Traceback" not in error
    assert time.process_time() - begin < 60


def test_names_that_no_text_can_hold(tmp_path, capsys) -> None:
    record = record_of(frames=6000)
    file = tmp_path / "a\x01.npz"
    np.savez(file, measurements=record.measurements, commands=record.commands)
    status, _, error = run(
        capsys,
        "auto",
        file,
        "-o",
        tmp_path / "q.fits",
        "--frame-rate-hz",
        1000,
        "--delay-frames",
        2,
        "--unit",
        "nm",
        "--no-figure",
    )
    assert (status, error) == (0, "")
    assert "a\\x01.npz" in (tmp_path / "q.yaml").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensor_gain": 1e300}, "sensor_gain must be"),
        ({"sensor_gain": "x"}, "sensor_gain must be numbers"),
        ({"announced": [31.0]}, "LinePrior"),
        ({"start": 3}, "IdentifiedModel"),
        ({"stretches": [(2, 4000), (3000, 5000)]}, "lie apart"),
        ({"stretches": [(0, 4000)]}, "usable"),
        ({"frame_rate_hz": 900.0}, "for spectra only"),
        ({"delay_frames": 3.0}, "with_delay"),
    ],
)
def test_bad_requests(options: dict[str, object], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        lbt.identify(record_of(frames=6000), **options)  # type: ignore[arg-type]


def test_a_dead_axis_is_named() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 2))
    y[:, 1] = 0
    record = lbt.identification.LoopRecord(
        frame_rate_hz=RATE,
        measurements=y,
        usable=np.ones(6000, dtype=bool),
        health=lbt.identification.RecordHealth(frames=6000, usable=6000),
    )
    with pytest.raises(ProblemError, match="axis 1 of the record is constant"):
        lbt.identify(record)


def test_a_design_is_doubted_where_the_gains_disagree() -> None:
    first = record_of((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    second = record_of((1,), lines=LINE, frames=20_000, sensor_gain=0.4)
    both = lbt.identification.loop_record(
        np.vstack([first.measurements, second.measurements]),
        np.vstack([first.commands, second.commands]),
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    try:
        notes = lbt.design_from_record(both).notes
    except lbt.errors.CertificateError as error:
        notes = (str(error),)
    assert any("sensor gain" in note for note in notes)
    assert lbt.design_from_record(first).notes == ()
