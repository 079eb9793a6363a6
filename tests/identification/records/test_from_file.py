"""Records from files and telemetry: facts, units, spectra, clocks, and what is refused."""

import hashlib
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.eris import ERIS_FILE
from support.predictions import SHELL
from support.record_files import csv, hdus, image, write_csv
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError

RATE = 500.0
AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=1000)
load = partial(lbt.load_record, frame_rate_hz=RATE)


def simulated(path, **truth):
    """The run of an integrator, and its telemetry."""
    law, air = lbt.integrator(path, gain=0.1).controller, lbt.Truth(turbulence=AIR, **truth)
    run = lbt.simulate(law, air, hardware=path, frames=99)
    return run, lbt.files.telemetry_from_simulation(run, path)


@pytest.mark.parametrize("name", ["a.fits", "a.npz"])
def test_telemetry_of_ours(tmp_path, name):
    path = lbt.LoopHardware(frame_rate_hz=1000, delay_frames=2.4)
    run, telemetry = simulated(path)
    file = lbt.files.save_telemetry(tmp_path / name, telemetry)
    seen = lbt.load_record(file)
    assert np.array_equal(seen.measurements, run.measurements[0])
    assert np.array_equal(seen.mirror_taps, path.mirror_taps)
    assert (seen.source, seen.shown_unit) == (str(file), "nm")
    mas = lbt.files.save_telemetry(tmp_path / f"m{name}", replace(telemetry, shown_unit="mas"))
    assert lbt.load_record(mas).shown_unit == "mas"
    assert not any("of another program" in note for note in seen.notes)
    assert lbt.load_record(file, axes=[1]).axes == 1
    words = f"{name}: .*neither columns nor commands"
    refused(lambda: lbt.load_record(file, columns={"measurements": 0}), ProblemError, words)


@pytest.mark.e2e
def test_telemetry_of_the_standard(tmp_path):
    y, u = np.random.default_rng(0).standard_normal((2, 50, 2))
    seen = lbt.files.Telemetry(frame_rate_hz=800, delay_frames=2, commands=u, measurements=y)
    back = lbt.load_record(lbt.files.save_telemetry(tmp_path / "a.aot.fits", seen))
    assert np.allclose(back.measurements, y)
    assert np.allclose(back.commands, u)
    assert np.flatnonzero(~back.usable).tolist() == [0, 1]


def test_the_control_loop_that_was_taken_is_named():
    """In the note, and in what is refused."""
    y, u = np.random.default_rng(0).standard_normal((2, 50, 3))
    loops = {"aot_loop": "HO loop", "aot_loops": "HO loop, TT loop"}
    seen = lbt.files.Telemetry(frame_rate_hz=800, commands=u, measurements=y, metadata=loops)
    said = "modes of HO loop, the one taken of the control loops HO loop, TT loop"
    words = f"there are 3 {said}; say which are tip and tilt"
    refused(lambda: lbt.load_record(seen), ProblemError, words)
    assert f"{said}; loop takes another" in lbt.load_record(seen, axes=(0, 1)).notes


def test_gaps_times_and_counters(tmp_path):
    path, y = tmp_path / "a.csv", np.random.default_rng(0).standard_normal(50)
    cells = {20: "", 30: "NaN"}
    kept = np.delete(np.arange(50), [7, 8])
    rows = [f"{100 + k},{2.0 * k},{cells.get(k, y[k])}" for k in kept]
    path.write_text("\n".join(["frame,timestamp_ms,pol_nm", *rows]))
    seen = lbt.load_record(path)
    assert seen.frame_rate_hz == 500
    assert np.flatnonzero(~seen.usable).tolist() == [7, 8, 20, 30]
    assert [finding.kind for finding in seen.findings] == ["missing", "not finite"]


def test_delays_and_diameters_in_headers(tmp_path, series):
    y, u = series
    images = image("Y", y, "mas"), image("U", u, "mas")
    cards = {"FRAMRATE": RATE, "DELAYFRM": 2.5, "DIAMETER": 8.0, "OBSTRUCT": 0.11}
    path = hdus(tmp_path / "a.fits", *images, **cards)
    seen = lbt.load_record(path)
    assert (seen.delay_frames, seen.diameter_m, seen.obstruction) == (2.5, 8.0, 0.11)
    assert "frame_rate_hz 500 by FRAMRATE of HDU 0" in seen.notes
    assert np.allclose(seen.measurements, lbt.models.nm_per_mas(8.0) * y)
    other = lbt.load_record(path, frame_rate_hz=1000, delay_frames=3, diameter_m=8.4)
    assert (other.frame_rate_hz, other.delay_frames, other.diameter_m) == (1000.0, 3.0, 8.4)
    assert "delay_frames 3 was given, in place of 2.5 by DELAYFRM of HDU 0" in other.notes
    for change, contradicts in ((5e-7, False), (1.5e-6, True)):
        notes = lbt.load_record(path, frame_rate_hz=(1 + change) * RATE).notes
        assert any("was given, in place of" in note for note in notes) is contradicts
    # a delay of unknown unit is not taken
    unsure = hdus(tmp_path / "b.fits", image("Y", y, "nm"), image("U", u, "nm"), DELAY=0.002)
    assert load(unsure).delay_frames is None


@pytest.mark.parametrize("form", ["csv", "fits"])
def test_spectra(tmp_path, form):
    f, path = np.linspace(5, 100, 300), tmp_path / f"a.{form}"
    s = 90 / (1 + ((f[:, None] - [20, 45]) / 2) ** 2)
    if form == "csv":
        write_csv(path, ["freq_hz", "psd_x [nm^2/Hz]", "psd_y [nm^2/Hz]"], [f, *s.T])
    else:
        hdus(path, image("FREQUENCY", f, "Hz"), image("PSD", s.T, "nm2/Hz"))
    seen = load(path, averages=12)
    assert isinstance(seen, lbt.identification.SpectrumRecord)
    assert np.array_equal(seen.frequency_hz, f)
    assert np.allclose(seen.density_nm2_hz, s)
    assert (seen.averages, seen.frame_rate_hz, seen.axes) == (12, RATE, 2)
    # a Lorentzian's integral, arctan
    exact = [90 * 2 * (np.arctan((100 - c) / 2) - np.arctan((5 - c) / 2)) for c in (20, 45)]
    assert seen.rms_nm**2 == pytest.approx(exact, rel=1e-3)


def test_amplitude_spectra_and_angles(tmp_path):
    f, nm = np.linspace(1, 50, 40), lbt.models.nm_per_mas(8.0)
    for name, unit, density in (
        ("asd_mas_rthz", None, (3 * nm) ** 2),
        ("psd", "mas^2/Hz", 3 * nm**2),
    ):
        path = write_csv(tmp_path / "a.csv", ["f_hz", name], [f, 0 * f + 3])
        seen = lbt.load_record(path, diameter_m=8.0, unit=unit)
        assert np.allclose(seen.density_nm2_hz, density)
    words = r"unit must be one of nm\^2/Hz, .*; got 'nm'"
    refused(lambda: lbt.load_record(path, unit="nm"), ProblemError, words)
    (tmp_path / "gaps.csv").write_text("f_hz,psd_nm2_hz\n1,2\n2,\n3,5\n4,-\n5,6\n")
    seen = lbt.load_record(tmp_path / "gaps.csv")
    assert seen.frequency_hz.tolist() == [1, 3, 5]
    assert seen.notes[-1].startswith("2 rows with gaps")
    for column, words in ((f[::-1], "must increase"), (f, "at least 0")):
        wrong = write_csv(tmp_path / "d.csv", ["f_hz", "asd_nm_rthz"], [column, 3 - f])
        refused(partial(lbt.load_record, wrong), ProblemError, words)


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        ("", {}, "got a column without a name; .*Choose by columns="),
        ("y_nm a b c", {}, r"got measurements \(y_nm\); a; b; c\. Choose by columns="),
        ("x_nm y_nm", {}, r"got measurements \(x_nm, y_nm\)\. Choose by columns="),
        ("y_nm u_nm pol_nm", {}, r"got measurements \(y_nm\); commands .*Choose by col"),
        ("y_nm meas_nm u_nm u_nm", {}, "not each of an axis of its own"),
        ("y_nm u_nm t time", {}, "t, time are all named as times; choose by columns="),
        ("y_nm u_nm time_h b", {"columns": {"times": 9}}, "no column 9; the file has 4"),
        ("y_nm u_nm a b", {"columns": {"times": "q"}}, "no column 'q'; .*: y_nm, u_nm"),
        ("y_nm u_nm a b", {"columns": {"clock": 2}}, "a key of columns must be one of"),
        ("y_nm u_nm a b", {"columns": ["a"]}, "columns must be a mapping"),
        ("a b c d", {"columns": {"open_loop": ("a", 0)}}, "a column was chosen twice"),
        ("y_nm u_nm time", {"frame_rate_hz": None}, "nothing .* give frame_rate_hz, or times who"),
        ("y_nm u_nm t_[Hz] b", {}, "times must be in one of s, ms, us, ns; got 'Hz'"),
        ("pol", {}, "nothing tells the unit of pol: give unit"),
        ("pol_nm", {"unit": "mas"}, "unit must be that of the data, 'nm'; got 'mas'"),
        ("pol0_nm pol1_um", {}, "pol0_nm, pol1_um must all have the same unit; got nm, um"),
        ("pol_nm", {"averages": 3}, "averages are only for a spectrum"),
        ("pol_nm", {"loop": "TT loop"}, "loop chooses a control loop of .*Leave it out"),
        ("pol_nm", {"loop": 0}, "loop chooses a control loop of .*Leave it out"),
    ],
)
def test_what_is_refused(tmp_path, series, names, options, words):
    columns = np.hstack(series).T[: len(names.split()) or None]
    path = write_csv(tmp_path / "night.csv", names.split(), columns)
    assert "night.csv" in str(refused(partial(load, path, **options), ProblemError, words))


def test_headers_and_arrays_that_are_refused(tmp_path, series):
    y, _ = series
    np.savez(tmp_path / "a.npz", pol0_nm=y[:, 0], pol1_nm=y[1:, 1], fs=RATE)
    hdus(tmp_path / "b.fits", image("POL", y, "pixel"), FPS=RATE)
    hdus(tmp_path / "c.fits", image("POL", y, "arcsec"), FPS=RATE)
    hdus(tmp_path / "d.fits", image("POL", y, "nm", FPS=400.0), FRAMRATE=RATE)
    rows = [
        ("a.npz", "pol0_nm and pol1_nm must be equally long; got 59 and 60 rows"),
        ("b.fits", "unit must be one of nm.*got 'pixel'"),
        ("c.fits", r"c\.fits: nothing tells the telescope.*give diameter_m"),
        ("d.fits", "the file gives frame_rate_hz twice"),
    ]
    require_refusals(
        (partial(lbt.load_record, tmp_path / name), ProblemError, words) for name, words in rows
    )
    refused(partial(lbt.load_record, y), ProblemError, "loop_record .* a file; got ndarray")


def test_data_come_unchanged_with_their_licence():
    readme = (ERIS_FILE.parent / "README.md").read_text("utf-8")
    assert hashlib.sha256(ERIS_FILE.read_bytes()).hexdigest() in readme
    licence = (ERIS_FILE.parent / "LICENSE.astro-tiptop").read_text("utf-8")
    assert "Copyright (c) 2021 FabioRossiArcetri" in licence
    assert "The above copyright notice and this permission notice shall be included" in licence


def test_file_without_names_is_read_as_a_spectrum():
    read = partial(lbt.load_record, ERIS_FILE, columns={"frequency": 0, "density": (1, 2)})
    spectrum = read(unit="nm^2/Hz")
    assert (spectrum.axes, spectrum.frequency_hz.size, spectrum.averages) == (2, 3393, None)
    assert spectrum.rms_nm == pytest.approx([94.6, 101.5], abs=0.05)
    refused(read, ProblemError, r"the unit of \[1\], \[2\]: give unit \(nm\^2/Hz")


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
    seen = load(mine, commands=theirs, unit="nm", delay_frames=2)
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
        refused(partial(load, mine, commands=theirs), TelemetryError, words)
    np.save(tmp_path / "v.npy", u[:-1])
    for name, words in (("v", "as many frames as the .* got 59, 60"), ("w", "No such file")):
        join = partial(lbt.load_record, by_time, commands=tmp_path / f"{name}.npy", unit="nm")
        refused(join, TelemetryError, words)


def test_both_files_tell_facts_and_each_its_own_unit(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", ("unit = mas", "diameter_m = 8.0"), y=y)
    slow = csv(tmp_path / "u.csv", ("frame_rate_hz = 250", "delay_frames = 2"), u_nm=u)
    seen = lbt.load_record(mine, commands=slow)
    assert (seen.frame_rate_hz, seen.delay_frames) == (250.0, 2.0)
    assert np.allclose(seen.measurements[:, 0], lbt.models.nm_per_mas(8.0) * y)
    assert np.allclose(seen.commands[:, 0], u)
    join = partial(load, mine, commands=csv(tmp_path / "v.csv", u=u))
    refused(join, ProblemError, "nothing tells the unit of u: give command_unit")
    words = "command_unit must be one of nm, .*'V'.*volts"
    refused(partial(join, command_unit="V"), ProblemError, words)
    assert np.allclose(join(command_unit="um").commands[:, 0], 1e3 * u)


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
    run, seen = simulated(path, sensor_gain=0.7)
    seen = lbt.load_record(seen)
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
    refused(lambda: lbt.load_record(bare, axes=(0, 1)), ProblemError, words)


def test_telemetry_that_is_refused():
    three = {"commands": np.ones((60, 3)), "interaction_matrix": np.eye(2)}
    rows = [
        ({}, {"unit": "mas"}, "unit must be that of the data, 'nm'; got 'mas'"),
        ({"measurement_unit": "pixel"}, {}, "the unit of mode 0 in 'pixel', .*: give unit"),
        ({"command_unit": "V"}, {}, "the unit of mode 0 in 'V', mode 1 in 'V': give command_unit"),
        (three, {}, "3 commands of 2 modes, and no influence matrix"),
        ({"interaction_matrix": [[1.0, 1.0], [1.0, 1.0]]}, {}, "has no inverse"),
    ]
    require_refusals(
        (partial(lbt.load_record, telemetry(**changes), **options), ProblemError, words)
        for changes, options, words in rows
    )


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
