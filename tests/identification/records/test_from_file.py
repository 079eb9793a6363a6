"""Records from files: every format, facts, units, spectra, and what is refused."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from astropy.io import fits
from support.eris import ERIS_FILE
from support.record_files import csv, hdus, image, write_csv
from support.records import SHELL, ran

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError

RATE = 500.0


@pytest.mark.parametrize("kind", ["csv", "blanks", "images", "table", "npz", "npy"])
def test_every_format_gives_the_same_record(tmp_path, series, kind):
    y, u = series
    options, time_s = {"delay_frames": 2}, np.arange(60) / RATE
    path = tmp_path / f"a.{'csv' if kind == 'blanks' else kind if kind[0] in 'cn' else 'fits'}"
    if kind in ("csv", "blanks"):
        names = ["time_s", "y0_nm", "y1_nm", "u0_nm", "u1_nm"]
        write_csv(path, names, [time_s, *y.T, *u.T], sign="," if kind == "csv" else " ")
    elif kind == "images":  # turned
        commands = image("COMMANDS", u.T.astype(">f8"), "nm")
        hdus(path, image("RESIDUALS", y.T, "nm"), commands, FRAMRATE=RATE)
    elif kind == "table":
        columns = [
            fits.Column(name="TIME", format="D", array=time_s, unit="s"),
            fits.Column(name="Residuals", format="2D", array=y, unit="nm"),
            fits.Column(name="Commands", format="2D", array=u, unit="nm"),
        ]
        hdus(path, fits.BinTableHDU.from_columns(columns))
    elif kind == "npz":
        np.savez(path, measurements=y, commands=u.T, frame_rate_hz=RATE, unit="nm")
    else:
        np.save(path, np.hstack([y, u]))
        chosen = {"measurements": (0, 1), "commands": (2, 3)}
        options |= {"unit": "nm", "frame_rate_hz": RATE, "columns": chosen}
    seen = lbt.load_record(path, **options)
    assert isinstance(seen, lbt.identification.LoopRecord)
    assert np.array_equal(seen.measurements, y)
    assert np.array_equal(seen.commands, u)
    assert (seen.frame_rate_hz, seen.delay_frames, seen.source) == (RATE, 2.0, str(path))
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1]
    text = " | ".join(seen.notes)
    assert "measurements: " in text
    assert "commands: " in text


@pytest.mark.parametrize("name", ["a.fits", "a.npz"])
def test_telemetry_of_ours(tmp_path, name):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.4)
    run = ran(path, frames=99)
    telemetry = lbt.files.telemetry_from_simulation(run, path)
    file = lbt.files.save_telemetry(tmp_path / name, telemetry)
    seen = lbt.load_record(file)
    assert np.array_equal(seen.measurements, run.measurements[0])
    assert np.array_equal(seen.mirror_taps, path.mirror_taps)
    assert seen.source == str(file)
    assert not any("of another program" in note for note in seen.notes)
    assert lbt.load_record(file, axes=[1]).axes == 1
    with pytest.raises(ProblemError, match=f"{name}: .*neither columns nor commands"):
        lbt.load_record(file, columns={"measurements": 0})


@pytest.mark.e2e
def test_telemetry_of_the_standard(tmp_path):
    y, u = np.random.default_rng(0).standard_normal((2, 50, 2))
    seen = lbt.files.Telemetry(frame_rate_hz=800, delay_frames=2, commands=u, measurements=y)
    back = lbt.load_record(lbt.files.save_telemetry(tmp_path / "a.aot.fits", seen))
    assert np.allclose(back.measurements, y)
    assert np.allclose(back.commands, u)
    assert np.flatnonzero(~back.usable).tolist() == [0, 1]


def test_gaps_times_and_counters(tmp_path):
    path = tmp_path / "a.csv"
    rng = np.random.default_rng(0)
    rows = ["frame,timestamp_ms,y_nm"]
    for k in np.delete(np.arange(50), [7, 8]):
        value = "" if k == 20 else "NaN" if k == 30 else f"{rng.standard_normal():.6f}"
        rows.append(f"{100 + k},{2.0 * k},{value}")
    path.write_text("\n".join(rows).replace("y_nm", "pol_nm"))
    seen = lbt.load_record(path)
    assert seen.frame_rate_hz == 500
    assert np.flatnonzero(~seen.usable).tolist() == [7, 8, 20, 30]
    assert [each.kind for each in seen.findings] == ["missing", "not finite"]
    with pytest.raises(ProblemError, match=r"a\.csv: frame_rate_hz must be that of the times"):
        lbt.load_record(path, frame_rate_hz=800)


def test_delays_and_diameters_in_headers(tmp_path, series):
    y, u = series
    path = hdus(
        tmp_path / "a.fits",
        image("Y", y, "mas"),
        image("U", u, "mas"),
        FRAMRATE=RATE,
        DELAYFRM=2.5,
        DIAMETER=8.0,
        OBSTRUCT=0.11,
    )
    seen = lbt.load_record(path)
    assert (seen.delay_frames, seen.diameter_m, seen.obstruction) == (2.5, 8.0, 0.11)
    assert "frame_rate_hz 500 by FRAMRATE of HDU 0" in seen.notes
    with pytest.raises(ProblemError, match="averages are only for a spectrum"):
        lbt.load_record(path, averages=3)
    assert np.allclose(seen.measurements, lbt.models.nm_per_mas(8.0) * y)
    other = lbt.load_record(path, frame_rate_hz=1000, delay_frames=3, diameter_m=8.4)
    assert (other.frame_rate_hz, other.delay_frames, other.diameter_m) == (1000.0, 3.0, 8.4)
    assert "delay_frames 3 was given, in place of 2.5 by DELAYFRM of HDU 0" in other.notes
    for change, contradicts in ((5e-7, False), (1.5e-6, True)):
        notes = lbt.load_record(path, frame_rate_hz=(1 + change) * RATE).notes
        assert any("was given, in place of" in note for note in notes) is contradicts
    # a delay of unknown unit is not taken
    unsure = hdus(tmp_path / "b.fits", image("Y", y, "nm"), image("U", u, "nm"), DELAY=0.002)
    seen = lbt.load_record(unsure, frame_rate_hz=RATE)
    assert seen.delay_frames is None
    twice = hdus(tmp_path / "c.fits", image("POL", y, "nm", FPS=400.0), FRAMRATE=RATE)
    with pytest.raises(ProblemError, match="the file gives frame_rate_hz twice"):
        lbt.load_record(twice)


def test_units_must_be_given(tmp_path, series):
    y, _ = series
    path = write_csv(tmp_path / "a.csv", ["pol"], [y[:, 0]])
    with pytest.raises(ProblemError, match="nothing tells the unit of pol: give unit"):
        lbt.load_record(path, frame_rate_hz=RATE)
    assert lbt.load_record(path, frame_rate_hz=RATE, unit="um").measurements[0, 0] == pytest.approx(
        1e3 * y[0, 0]
    )
    named = write_csv(tmp_path / "b.csv", ["pol_nm"], [y[:, 0]])
    with pytest.raises(ProblemError, match="unit must be that of the data, 'nm'; got 'mas'"):
        lbt.load_record(named, frame_rate_hz=RATE, unit="mas", diameter_m=8)
    assert lbt.load_record(named, frame_rate_hz=RATE, unit="nanometer").axes == 1
    mixed = write_csv(tmp_path / "c.csv", ["pol0_nm", "pol1_um"], y.T)
    pixels = hdus(tmp_path / "d.fits", image("POL", y, "pixel"), FPS=RATE)
    angle = hdus(tmp_path / "e.fits", image("POL", y, "arcsec"), FPS=RATE)
    np.savez(tmp_path / "f.npz", pol0_nm=y[:, 0], pol1_nm=y[1:, 1])
    for file, words in (
        (tmp_path / "f.npz", "pol0_nm and pol1_nm must be equally long; got 59 and 60 rows"),
        (mixed, "pol0_nm, pol1_um must all have the same unit; got nm, um"),
        (pixels, "unit must be one of nm.*got 'pixel'"),
        (angle, r"e\.fits: nothing tells the telescope.*give diameter_m"),
    ):
        with pytest.raises(ProblemError, match=words):
            lbt.load_record(file, frame_rate_hz=RATE)


@pytest.mark.parametrize("form", ["csv", "fits"])
def test_spectra(tmp_path, form):
    f = np.linspace(5, 100, 300)
    s = 90 / (1 + ((f[:, None] - [20, 45]) / 2) ** 2)
    path = tmp_path / f"a.{form}"
    if form == "csv":
        write_csv(path, ["freq_hz", "psd_x [nm^2/Hz]", "psd_y [nm^2/Hz]"], [f, *s.T])
    else:
        hdus(path, image("FREQUENCY", f, "Hz"), image("PSD", s.T, "nm2/Hz"))
    seen = lbt.load_record(path, averages=12, frame_rate_hz=RATE)
    assert isinstance(seen, lbt.identification.SpectrumRecord)
    assert np.array_equal(seen.frequency_hz, f)
    assert np.allclose(seen.density_nm2_hz, s)
    assert (seen.averages, seen.frame_rate_hz, seen.axes) == (12, RATE, 2)
    # a Lorentzian's integral, arctan
    exact = [90 * 2 * (np.arctan((100 - c) / 2) - np.arctan((5 - c) / 2)) for c in (20, 45)]
    assert seen.rms_nm**2 == pytest.approx(exact, rel=1e-3)


def test_amplitude_spectra_and_angles(tmp_path):
    f = np.linspace(1, 50, 40)
    path = write_csv(tmp_path / "a.csv", ["f_hz", "asd_mas_rthz"], [f, 0 * f + 3])
    seen = lbt.load_record(path, diameter_m=8.0)
    assert np.allclose(seen.density_nm2_hz, (3 * lbt.models.nm_per_mas(8.0)) ** 2)
    power = write_csv(tmp_path / "b.csv", ["f_hz", "psd"], [f, 0 * f + 3])
    seen = lbt.load_record(power, unit="mas^2/Hz", diameter_m=8.0)
    assert np.allclose(seen.density_nm2_hz, 3 * lbt.models.nm_per_mas(8.0) ** 2)
    with pytest.raises(ProblemError, match="unit must be one of nm\\^2/Hz, .*; got 'nm'"):
        lbt.load_record(power, unit="nm")
    (tmp_path / "gaps.csv").write_text("f_hz,psd_nm2_hz\n1,2\n2,\n3,5\n4,-\n5,6\n")
    seen = lbt.load_record(tmp_path / "gaps.csv")
    assert seen.frequency_hz.tolist() == [1, 3, 5]
    assert seen.notes[-1].startswith("2 rows with gaps")
    for column, words in ((f[::-1], "must increase"), (f, "at least 0")):
        wrong = write_csv(tmp_path / "d.csv", ["f_hz", "asd_nm_rthz"], [column, 3 - f])
        with pytest.raises(ProblemError, match=words):
            lbt.load_record(wrong)


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        ([], {}, "got a column without a name; .*Choose by columns="),
        (["y_nm", "a", "b", "c"], {}, r"got measurements \(y_nm\); a; b; c\. Choose by columns="),
        (["y_nm", "meas_nm", "u_nm", "u_nm"], {}, "not each of an axis of its own"),
        (["y0_nm", "y1_nm", "u0_nm", "t"], {}, r"commands must match measurements \(60, 2\)"),
        (["y_nm", "u_nm", "t", "time"], {}, "t, time are all named as times; choose by columns="),
        (["y_nm", "u_nm", "time_h", "b"], {"columns": {"times": 9}}, "no column 9; the file has 4"),
        (["y_nm", "u_nm", "a", "b"], {"columns": {"times": "q"}}, "no column 'q'; .*: y_nm, u_nm"),
        (["y_nm", "u_nm", "a", "b"], {"columns": {"clock": 2}}, "a key of columns must be one of"),
        (["y_nm", "u_nm", "a", "b"], {"columns": ["a"]}, "columns must be a mapping"),
        (list("abcd"), {"columns": {"open_loop": ("a", 0)}}, "a column was chosen twice"),
        (["y_nm", "u_nm", "a", "b"], {"frame_rate_hz": None}, "nothing tells the frame rate: give"),
        (["y_nm", "u_nm", "time", "b"], {"frame_rate_hz": None}, "or times whose name has a unit"),
        (["y_nm", "u_nm", "t [Hz]", "b"], {}, "times must be in one of s, ms, us, ns; got 'Hz'"),
    ],
)
def test_what_is_refused(tmp_path, series, names, options, words):
    y, u = series
    path = write_csv(tmp_path / "night.csv", names, [*y.T, *u.T])
    with pytest.raises(ProblemError, match=words) as caught:
        lbt.load_record(path, **{"frame_rate_hz": RATE, **options})
    assert "night.csv" in str(caught.value)


def test_data_come_unchanged_with_their_licence():
    readme = (ERIS_FILE.parent / "README.md").read_text("utf-8")
    assert hashlib.sha256(ERIS_FILE.read_bytes()).hexdigest() in readme
    licence = (ERIS_FILE.parent / "LICENSE.astro-tiptop").read_text("utf-8")
    assert "Copyright (c) 2021 FabioRossiArcetri" in licence
    assert "The above copyright notice and this permission notice shall be included" in licence


def test_file_without_names_is_read_as_a_spectrum():
    choice = {"frequency": 0, "density": (1, 2)}
    found = lbt.load_record(ERIS_FILE, columns=choice, unit="nm^2/Hz")
    assert (found.axes, found.frequency_hz.size, found.averages) == (2, 3393, None)
    assert found.rms_nm == pytest.approx([94.6, 101.5], abs=0.05)
    with pytest.raises(ProblemError, match=r"the unit of \[1\], \[2\]: give unit \(nm\^2/Hz"):
        lbt.load_record(ERIS_FILE, columns=choice)


TIMES = np.arange(60) / RATE + 0.02
LAID = {  # clocks of measurements and commands, and which command each row has
    "row by row": ({}, {}, np.arange(60)),
    "counters": ({"frame": np.arange(10, 70)}, {"frame": np.arange(60)}, np.arange(10, 70)),
    "times": ({"time_s": TIMES}, {"time_ms": 1e3 * (TIMES - 0.4 / RATE)}, np.arange(60)),
    "later": ({"time_s": TIMES}, {"time_s": TIMES + 5 / RATE}, np.arange(-5, 55)),
}


@pytest.mark.parametrize("by", LAID)
def test_commands_of_another_file_are_laid_beside_the_measurements(tmp_path, series, by):
    """Axes have the order of their columns, unless the names tell another."""
    y, u = series
    clock, other, row = LAID[by]
    names = {"u1": u[:, 1], "u0": u[:, 0]} if by == "later" else {"p": u[:, 0], "q": u[:, 1]}
    mine = csv(tmp_path / "y.csv", **clock, p=y[:, 0], q=y[:, 1])
    theirs = csv(tmp_path / "u.csv", **other, **names)
    seen = lbt.load_record(mine, commands=theirs, frame_rate_hz=RATE, unit="nm", delay_frames=2)
    there = (row >= 0) & (row < 60)
    assert np.array_equal(seen.measurements, y)
    assert np.array_equal(seen.commanded, there)
    assert np.array_equal(seen.commands[there], u[row[there]])
    assert f"commands are from {theirs}" in seen.notes
    words = f"commands were laid beside the measurements by {next(iter(other), '')}: "
    assert any(f"{words}{there.sum()} of 60 rows" in note for note in seen.notes) is bool(other)


def test_files_that_do_not_belong_together(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    by_frame = csv(tmp_path / "y.csv", frame=np.arange(10, 70), y_nm=y)
    by_time = csv(tmp_path / "t.csv", time_s=TIMES, y_nm=y)
    for mine, clock, words in (
        (by_frame, {"frame": np.arange(500, 560)}, "got 500 to 559, and 10 to 69"),
        (by_frame, {"frame": np.arange(60) // 2 * 2}, "must have frame numbers that rise"),
        (by_time, {"time_ms": 1e3 * TIMES + 1.0}, "must have times that rise, and are those"),
    ):
        theirs = csv(tmp_path / "u.csv", **clock, u_nm=u)
        with pytest.raises(TelemetryError, match=words):
            lbt.load_record(mine, commands=theirs, frame_rate_hz=RATE)
    for name, words in (("v", "as many frames as the .* got 59, 60"), ("w", "No such file")):
        np.save(tmp_path / "v.npy", u[:-1])
        with pytest.raises(TelemetryError, match=words):
            lbt.load_record(by_time, commands=tmp_path / f"{name}.npy", unit="nm")


def test_both_files_tell_facts_and_each_its_own_unit(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", ("unit = mas", "diameter_m = 8.0"), y=y)
    slow = csv(tmp_path / "u.csv", ("frame_rate_hz = 250", "delay_frames = 2"), u_nm=u)
    seen = lbt.load_record(mine, commands=slow)
    assert (seen.frame_rate_hz, seen.delay_frames) == (250.0, 2.0)
    assert np.allclose(seen.measurements[:, 0], lbt.models.nm_per_mas(8.0) * y)
    assert np.allclose(seen.commands[:, 0], u)
    silent = csv(tmp_path / "v.csv", u=u)
    with pytest.raises(ProblemError, match="nothing tells the unit of u: give command_unit"):
        lbt.load_record(mine, commands=silent, frame_rate_hz=RATE)
    with pytest.raises(ProblemError, match="command_unit must be one of nm, .*'V'.*volts"):
        lbt.load_record(mine, commands=silent, frame_rate_hz=RATE, command_unit="V")
    seen = lbt.load_record(mine, commands=silent, frame_rate_hz=RATE, command_unit="um")
    assert np.allclose(seen.commands[:, 0], 1e3 * u)


def telemetry(**changes):
    y, u = np.random.default_rng(2).standard_normal((2, 60, 2))
    fields = {"frame_rate_hz": 1000.0, "delay_frames": 2.0, "commands": u, "measurements": y}
    return lbt.files.Telemetry(**{**fields, **changes})


def test_telemetry_of_a_simulation_with_matrices():
    rng = np.random.default_rng(3)
    path = lbt.LoopHardware(
        frame_rate_hz=1000.0,
        delay_frames=2.25,
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=np.eye(2) + 0.1 * rng.standard_normal((2, 2)),
        mirror=SHELL,
    )
    run = ran(path, sensor_gain=0.7)
    seen = lbt.load_record(lbt.files.telemetry_from_simulation(run, path))
    first = len(path.mirror_taps)
    z = seen.pseudo_open_loop(0.7)[first:]
    assert np.allclose(z, run.total_nm[0, first - 1 : -1], rtol=1e-9, atol=1e-8)
    words = "measurements: the inverse of the interaction matrix times what was recorded"
    assert words in seen.notes


def test_slopes_with_their_modes_and_without():
    rng = np.random.default_rng(0)
    S, phase = rng.standard_normal((8, 3)), rng.standard_normal((60, 3))
    slopes, R = phase @ S.T, np.linalg.pinv(S)
    seen = telemetry(measurements=slopes @ R.T, interaction_matrix=R @ S, commands=phase)
    assert np.allclose(lbt.load_record(seen, axes=(0, 1)).measurements, phase[:, :2])
    words = "has 8 measurements and 3 modes: slopes without modal .*slopes @ reconstructor.T"
    bare = telemetry(measurements=slopes, interaction_matrix=S, commands=phase)
    with pytest.raises(ProblemError, match=words):
        lbt.load_record(bare, axes=(0, 1))


@pytest.mark.parametrize(
    ("telemetry_changes", "options", "words"),
    [
        ({}, {"unit": "mas"}, "unit must be that of the data, 'nm'; got 'mas'"),
        ({"measurement_unit": "pixel"}, {}, "the unit of mode 0 in 'pixel', .*: give unit"),
        ({"command_unit": "V"}, {}, "the unit of mode 0 in 'V', mode 1 in 'V': give command_unit"),
        (
            {"commands": np.ones((60, 3)), "interaction_matrix": np.eye(2)},
            {},
            "3 commands of 2 modes, and no influence matrix",
        ),
        ({"interaction_matrix": [[1.0, 1.0], [1.0, 1.0]]}, {}, "has no inverse"),
        ({"delay_frames": 0.5}, {}, "delay_frames must be at least 1"),
    ],
)
def test_telemetry_that_is_refused(telemetry_changes, options, words):
    with pytest.raises(ProblemError, match=words):
        lbt.load_record(telemetry(**telemetry_changes), **options)


def test_what_telemetry_does_not_tell_is_given():
    seen = telemetry(measurement_unit="px", command_unit="V", delay_frames=None)
    known = {"delay_frames": 2.5, "diameter_m": 8.0, "unit": "mas", "command_unit": "nm"}
    record = lbt.load_record(seen, **known)
    assert record.delay_frames == 2.5
    assert np.allclose(record.measurements, lbt.models.nm_per_mas(8.0) * seen.measurements)
    assert np.array_equal(record.commands, seen.commands)
    # a unit of the measurements is none of commands that have their own
    half = lbt.load_record(telemetry(measurement_unit="px", command_unit="nm"), unit="m")
    assert np.allclose(half.measurements, 1e9 * seen.measurements)
    assert np.array_equal(half.commands, seen.commands)
