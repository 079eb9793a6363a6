"""Records of two files, axes and units that do not belong together, and other near misses."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

import lbt_synth as lbt

RATE = 500.0
FRAMES = 60


@pytest.fixture
def series():
    rng = np.random.default_rng(0)
    return 20 * rng.standard_normal((FRAMES, 2)), 20 * rng.standard_normal((FRAMES, 2))


def csv(path, text=(), **columns):
    rows = [",".join(columns)]
    rows += [",".join(repr(float(v)) for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([*(f"# {line}" for line in text), *rows]) + "\n")
    return path


# ------------------------------------------------------------------ two files
def test_two_files_are_laid_beside_each_other_by_their_counters(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", frame=np.arange(10, 70), y_nm=y)
    theirs = csv(tmp_path / "u.csv", frame=np.arange(60), u_nm=u)
    seen = lbt.load_record(mine, commands=theirs, frame_rate_hz=RATE, delay_frames=2)
    assert np.array_equal(seen.measurements[:50, 0], y[:50])
    assert np.array_equal(seen.commands[:50, 0], u[10:])
    # commands 60 ... 69 are not there: y(k) holds u(k-2)
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1, *range(52, 60)]
    assert any("by frame: 50 of 60 rows have one" in note for note in seen.health.notes)
    longer = csv(tmp_path / "l.csv", frame=np.arange(70), u_nm=np.append(u, u[:10]))
    seen = lbt.load_record(mine, commands=longer, frame_rate_hz=RATE, delay_frames=2)
    assert np.array_equal(seen.commands[:, 0], np.append(u, u[:10])[10:])
    far = csv(tmp_path / "f.csv", frame=np.arange(500, 560), u_nm=u)
    with pytest.raises(lbt.errors.TelemetryError, match="only 0 of 60 measurements have a command"):
        lbt.load_record(mine, commands=far, frame_rate_hz=RATE)
    twice = csv(tmp_path / "t.csv", frame=np.arange(60) // 2 * 2, u_nm=u)
    with pytest.raises(lbt.errors.TelemetryError, match="must rise from row to row to be matched"):
        lbt.load_record(mine, commands=twice, frame_rate_hz=RATE)
    back = csv(tmp_path / "b.csv", frame=np.arange(60)[::-1], u_nm=u)
    with pytest.raises(lbt.errors.TelemetryError, match="of both files must rise, without gaps"):
        lbt.load_record(mine, commands=back, frame_rate_hz=RATE)


def test_two_files_are_laid_beside_each_other_by_their_times(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", time_s=np.arange(60) / RATE + 0.02, y_nm=y)
    theirs = csv(tmp_path / "u.csv", time_ms=np.arange(60) * 1e3 / RATE + 0.1, u_nm=u)
    seen = lbt.load_record(mine, commands=theirs, delay_frames=2)
    assert np.array_equal(seen.commands[:50, 0], u[10:])
    assert seen.frame_rate_hz == pytest.approx(RATE)
    between = csv(tmp_path / "b.csv", time_ms=np.arange(60) * 1e3 / RATE + 1.0, u_nm=u)
    with pytest.raises(lbt.errors.TelemetryError, match="only 0 of 60 measurements have a command"):
        lbt.load_record(mine, commands=between)
    bare = csv(tmp_path / "n.csv", u_nm=u)
    seen = lbt.load_record(mine, commands=bare)
    assert np.array_equal(seen.commands[:, 0], u)
    assert any("no clock in common" in note for note in seen.health.notes)
    short = csv(tmp_path / "s.csv", u_nm=u[:-1])
    with pytest.raises(
        lbt.errors.TelemetryError, match="as many frames as the measurements; got 59, 60"
    ):
        lbt.load_record(mine, commands=short)


def test_both_files_tell_facts_and_each_its_own_unit(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", ("unit = mas", "diameter_m = 8.0"), y=y)
    slow = csv(tmp_path / "u.csv", ("frame_rate_hz = 250", "delay_frames = 2"), u_nm=u)
    with pytest.raises(
        lbt.errors.ProblemError, match=r"must be that of the file, 250 by .* in u\.csv"
    ):
        lbt.load_record(mine, commands=slow, frame_rate_hz=RATE)
    seen = lbt.load_record(mine, commands=slow)
    assert (seen.frame_rate_hz, seen.delay_frames) == (250.0, 2.0)
    assert np.allclose(seen.measurements[:, 0], lbt.models.nm_per_mas(8.0) * y)
    assert np.allclose(seen.commands[:, 0], u)
    silent = csv(tmp_path / "v.csv", u=u)
    with pytest.raises(lbt.errors.ProblemError, match="unit of the commands; give command_unit"):
        lbt.load_record(mine, commands=silent, frame_rate_hz=RATE)
    seen = lbt.load_record(mine, commands=silent, frame_rate_hz=RATE, command_unit="um")
    assert np.allclose(seen.commands[:, 0], 1e3 * u)


# ----------------------------------------------------------------------- axes
def test_measurements_and_commands_are_of_the_same_axes(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    path = csv(tmp_path / "a.csv", tilt_nm=y, tip_cmd_nm=u)
    with pytest.raises(
        lbt.errors.ProblemError, match="of the same axes; got tilt_nm with tip_cmd_nm"
    ):
        lbt.load_record(path, frame_rate_hz=RATE)
    chosen = {"measurements": "tilt_nm", "commands": "tip_cmd_nm"}
    assert lbt.load_record(path, frame_rate_hz=RATE, columns=chosen).axes == 1
    one = csv(tmp_path / "b.csv", y_1_nm=y, y_2_nm=u, u_0_nm=y, u_1_nm=u)  # counted from 1
    assert np.array_equal(lbt.load_record(one, frame_rate_hz=RATE).commands, np.c_[y, u])
    mine = csv(tmp_path / "y.csv", tilt_nm=y)
    np.save(tmp_path / "u.npy", u)
    seen = lbt.load_record(mine, commands=tmp_path / "u.npy", frame_rate_hz=RATE, unit="nm")
    assert np.array_equal(seen.commands[:, 0], u)


def test_x_and_y_are_two_axes(tmp_path, series):
    y, u = series
    path = csv(tmp_path / "a.csv", x_nm=y[:, 0], y_nm=y[:, 1])
    seen = lbt.load_record(path, kind="open_loop", frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, y)
    both = csv(tmp_path / "b.csv", y_nm=y[:, 1], x_nm=y[:, 0], ux_nm=u[:, 0], uy_nm=u[:, 1])
    seen = lbt.load_record(both, frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, y)
    assert np.array_equal(seen.commands, u)
    # x is no axis where it is a clock
    clock = csv(tmp_path / "c.csv", x=np.arange(FRAMES), y_nm=y[:, 1])
    seen = lbt.load_record(clock, kind="open_loop", frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, y[:, 1:])


def test_a_clock_without_a_name_is_no_axis(tmp_path, series):
    path = tmp_path / "a.txt"
    np.savetxt(path, np.column_stack([np.arange(FRAMES) / RATE, series[0][:, 0]]))
    with pytest.raises(
        lbt.errors.ProblemError, match=r"column 0 .* rises from row to row, as a clock"
    ):
        lbt.load_record(path, kind="open_loop", unit="nm", frame_rate_hz=RATE)
    seen = lbt.load_record(path, columns={"times": 0, "open_loop": 1}, unit="nm")
    assert seen.frame_rate_hz == RATE


# ------------------------------------------------------------ delays, bridges
def test_another_delay_keeps_the_mirror_and_drops_the_bridges():
    shell = lbt.models.PositionLoop.of_bandwidth(
        natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=24_000
    )
    rng = np.random.default_rng(0)
    y, u = np.cumsum(rng.standard_normal((2, 2000)), axis=1)
    u[1000] = np.nan
    seen = lbt.identification.loop_record(
        y, u, frame_rate_hz=800, delay_frames=2, mirror=shell, unit="nm"
    )
    other = seen.with_delay(3)
    assert other.mirror is shell
    assert np.array_equal(
        other.mirror_taps,
        lbt.LoopHardware(frame_rate_hz=800, delay_frames=3, mirror=shell).mirror_taps,
    )
    plain = lbt.identification.loop_record(y, u, frame_rate_hz=800, delay_frames=2, unit="nm")
    whole = plain.bridged()
    assert whole.usable[1002]
    assert whole.measurements[1002, 0] != y[1002]
    assert not whole.with_delay(3).usable[1002]
    assert plain.with_delay(3).usable[1002]


# ---------------------------------------------------------------------- lines
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frequency_hz,error_hz\n20,0.1\n,0.2\n", "row 2 of the numbers has no frequency"),
        ("frequency_hz,rms_nm\n20,300\n", "must be frequency_hz, and frequency_error_hz.*rms_nm"),
        ("frequency_khz\n0.02\n", "must be frequency_hz"),
        ("f_hz,frequency_hz\n20,20\n", "must be frequency_hz"),
        ("error_hz\n20\n", "must have a column frequency_hz"),
    ],
)
def test_lists_of_lines_that_are_refused(tmp_path, text, words):
    path = tmp_path / "lines.csv"
    path.write_text(text)
    with pytest.raises(lbt.errors.TelemetryError, match=words):
        lbt.identification.load_lines(path)


def test_headings_of_lists_of_lines(tmp_path):
    path = tmp_path / "lines.csv"
    for heading in ("frequency_error_hz,frequency_hz", "Error [Hz],Frequency [Hz]", "sigma,f"):
        path.write_text(f"{heading}\n0.1,20\n,45\n")
        found = [
            (line.frequency_hz, line.frequency_error_hz)
            for line in lbt.identification.load_lines(path)
        ]
        assert found == [(20.0, 0.1), (45.0, 0.0)]


# ------------------------------------------------------------ what was ignored
def test_telemetry_takes_an_obstruction_and_refuses_averages(tmp_path, series):
    path = lbt.LoopHardware(frame_rate_hz=800)
    run = lbt.simulate(
        lbt.integrator(path, gain=0.3).controller,
        lbt.Truth(turbulence=None, noise_nm=5.0),
        hardware=path,
        frames=99,
    )
    file = lbt.files.save_telemetry(tmp_path / "a.fits", lbt.files.telemetry_from_simulation(run, path))
    assert lbt.load_record(file, obstruction=0.3).obstruction == 0.3
    with pytest.raises(lbt.errors.ProblemError, match="averages are of a spectrum"):
        lbt.load_record(file, averages=3)
    plain = csv(tmp_path / "b.csv", pol_nm=series[0][:, 0])
    with pytest.raises(lbt.errors.ProblemError, match="averages are of a spectrum"):
        lbt.load_record(plain, frame_rate_hz=RATE, averages=3)


# --------------------------------------------------------------------- faults
@pytest.mark.parametrize("scatter", [0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 2.0])
def test_clean_coarse_series_are_not_saturated(scatter):
    for seed in range(5):
        y = np.round(scatter * np.random.default_rng(seed).standard_normal(20_000))
        seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
        assert not [found for found in seen.health.findings if found.kind == "saturated"]


@pytest.mark.parametrize("step", [0.0, 0.5, 1.0])
def test_limits_are_still_found(step):
    y = 20 * np.random.default_rng(1).standard_normal(20_000)
    y = np.clip(y if step == 0 else step * np.round(y / step), -1e9, 40.0)
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    (found,) = [each for each in seen.health.findings if each.kind == "saturated"]
    assert found.count == np.sum(y == 40)


# ----------------------------------------------------------------------- FITS
def table(path, *columns, **cards):
    unit = fits.BinTableHDU.from_columns(columns)
    for key, value in cards.items():
        unit.header[key] = value
    unit.writeto(path)
    return path


def test_nulls_of_scaled_columns_and_images(tmp_path):
    rng = np.random.default_rng(0)
    raw = rng.integers(-1000, 1000, FRAMES).astype(np.int16)
    raw[10] = -999
    raw[11] = -998
    scaled = table(
        tmp_path / "a.fits",
        fits.Column("POL", "I", array=raw, null=-999, unit="nm"),
        TSCAL1=0.01,
        TZERO1=3.0,
        FPS=RATE,
    )
    unsigned = (raw.astype(int) + 32768).astype(np.uint16)
    column = fits.Column("POL", "I", array=unsigned, bzero=32768, null=-999, unit="nm")
    shifted = table(tmp_path / "b.fits", column, FPS=RATE)
    image = fits.PrimaryHDU(np.column_stack([raw, raw]))
    image.header.update({"BLANK": -999, "BUNIT": "nm", "FPS": RATE})
    image.writeto(tmp_path / "c.fits")
    image = fits.PrimaryHDU(np.column_stack([unsigned, unsigned]))
    image.header.update({"BUNIT": "nm", "FPS": RATE})
    image.writeto(tmp_path / "d.fits")
    fits.setval(tmp_path / "d.fits", "BLANK", value=-999)
    for path in (scaled, shifted, tmp_path / "c.fits", tmp_path / "d.fits"):
        chosen = {"open_loop": (0, 1)} if path.name in ("c.fits", "d.fits") else None
        seen = lbt.load_record(path, columns=chosen)
        assert np.flatnonzero(~seen.usable).tolist() == [10]
    assert lbt.load_record(scaled).measurements[11, 0] == pytest.approx(3 - 9.98)


def test_a_name_and_a_header_of_two_units(tmp_path, series):
    path = table(
        tmp_path / "a.fits", fits.Column("POL_mas", "D", array=series[0][:, 0], unit="nm"), FPS=RATE
    )
    with pytest.raises(
        lbt.errors.TelemetryError, match="POL_mas has the unit 'nm' in the header: which"
    ):
        lbt.load_record(path, diameter_m=8)
    same = table(
        tmp_path / "b.fits", fits.Column("POL_nm", "D", array=series[0][:, 0], unit="NM"), FPS=RATE
    )
    assert lbt.load_record(same).axes == 1


@pytest.mark.parametrize(
    ("comment", "delay"),
    [
        ("[ms] readout after end of frame", None),
        ("[s] in frames of 2 ms", None),
        ("after the end of the frame", None),
        ("[frames] of the loop", 2.5),
        ("total, in frames", 2.5),
        ("(frames)", 2.5),
    ],
)
def test_delays_that_are_in_frames(tmp_path, series, comment, delay):
    y = series[0][:, 0]
    path = table(
        tmp_path / "a.fits",
        fits.Column("Y", "D", array=y, unit="nm"),
        fits.Column("U", "D", array=y, unit="nm"),
        FPS=RATE,
        DELAY=(2.5, comment),
    )
    assert lbt.load_record(path).delay_frames == delay


def test_capitals_of_frequencies(tmp_path):
    f = np.linspace(1, 50, 40)
    for unit, factor in (("mHz", 1e-3), ("MHz", 1e6), ("kHz", 1e3), ("HZ", 1.0)):
        path = csv(tmp_path / "a.csv", **{f"f [{unit}]": f, "psd_nm2_hz": f})
        assert np.allclose(lbt.load_record(path).frequency_hz, factor * f)
    path = csv(tmp_path / "a.csv", f_mhz=f, psd_nm2_hz=f)
    with pytest.raises(
        lbt.errors.ProblemError, match="must be in one of Hz, kHz, mHz, MHz; got 'mhz'"
    ):
        lbt.load_record(path)


@pytest.mark.parametrize("step", [1.0, 2.0, 1 / 86.4e6])
def test_times_that_are_no_seconds(tmp_path, series, step):
    path = csv(tmp_path / "a.csv", time=10 + step * np.arange(FRAMES), pol_nm=series[0][:, 0])
    with pytest.raises(
        lbt.errors.ProblemError, match="Hz with time in seconds, and their unit is not to"
    ):
        lbt.load_record(path)


# ------------------------------------------------------------------------ NPZ
def test_facts_in_arrays_and_texts(tmp_path, series):
    path = tmp_path / "a.npz"
    y, u = series
    np.savez(path, y=y, u=u, unit="nm", frame_rate_hz=np.array([RATE]), delay_frames="2")
    seen = lbt.load_record(path)
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, 2.0)
    np.savez(path, y=y, u=u, unit="nm", frame_rate_hz="500 Hz", delay_frames="a few")
    seen = lbt.load_record(path)
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, None)
    assert "delay_frames was not taken for delay_frames: 'a few' is no number" in seen.health.notes
    comments = ("frame rate = 500 Hz", "unit: nm", "delay frames: two")
    seen = lbt.load_record(csv(tmp_path / "b.csv", comments, y=y[:, 0], u=u[:, 0]))
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, None)
    assert any("'two' is no number" in note for note in seen.health.notes)


def test_broken_archives_do_not_speak_of_pickles(tmp_path):
    for name, words in (("a.npz", "no ZIP archive"), ("a.npy", "does not begin as an NPY")):
        for content in (b"", b"PK", b"garbage"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(lbt.errors.TelemetryError, match=words) as caught:
                lbt.load_record(tmp_path / name)
            assert "pickle" not in str(caught.value)
