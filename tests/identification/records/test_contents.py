"""What files hold: nulls, facts in arrays and comments, damage, structures and groups.

Columns chosen by their names, their axes, or the call.
"""

import dataclasses
import gc
import sys
import tempfile
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from support.record_files import csv, sparta_table, write_csv, write_sav
from support.recorded_loops import integrator_loop
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification.records.contents import read_contents

RATE = 500.0


def test_damage(tmp_path):
    for name, content, words in (
        ("a.xls", b"", r"a record must end in \.fits, .*got 'a\.xls'"),
        ("a.csv", b"", "has no rows"),
        ("a.csv", b"y_nm,u_nm\n", "a heading and no rows"),
        ("a.csv", b"y_nm,u_nm\n1,2\n3\n", "line 3 must have 2 cells; got 1"),
        ("a.csv", b"\xff\xfe\x00", "cannot read .*a.csv as .csv: 'utf-8' codec can't decode"),
        ("a.npy", b"\x93NUMPY garbage", "cannot read .*a.npy as .npy"),
        ("a.npz", b"PK", "it begins as neither an NPY file nor a ZIP archive does"),
        ("a.fits", b"SIMPLE", "cannot read .*a.fits as .fits"),
        ("a.fits", b"", "cannot read .*a.fits as .fits"),
        ("a.h5", b"\x89HDF", "cannot read .*a.h5 as .h5"),
        ("a.mat", b"MATLAB 5.0", "cannot read .*a.mat as .mat"),
        ("a.mat", bytes(512) + b"\x89HDF\r\n\x1a\n", "cannot read .*a.mat as .mat"),
    ):
        (tmp_path / name).write_bytes(content)
        error = refused(partial(lbt.load_record, tmp_path / name), TelemetryError, words)
        assert "pickle" not in str(error)


FRAMES = 60


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
    for name, array in (("c.fits", raw), ("d.fits", unsigned)):
        image = fits.PrimaryHDU(np.column_stack([array, array]))
        image.header.update({"BUNIT": "nm", "FPS": RATE})
        image.writeto(tmp_path / name)
        fits.setval(tmp_path / name, "BLANK", value=-999)
    images = [(tmp_path / name, {"open_loop": (0, 1)}) for name in ("c.fits", "d.fits")]
    for path, chosen in ((scaled, None), (shifted, None), *images):
        seen = lbt.load_record(path, columns=chosen)
        assert np.flatnonzero(~seen.usable).tolist() == [10]
    assert lbt.load_record(scaled).measurements[11, 0] == pytest.approx(3 - 9.98)


def test_a_name_and_a_header_of_two_units(tmp_path, series):
    mas, nm = (
        table(
            tmp_path / f"{unit}.fits", fits.Column(f"POL_{unit}", "D", unit="NM", array=y), FPS=RATE
        )
        for unit, y in zip(("mas", "nm"), series[0].T, strict=True)
    )
    words = "POL_mas has the unit 'NM' in the header"
    refused(lambda: lbt.load_record(mas, diameter_m=8), TelemetryError, words)
    assert lbt.load_record(nm).axes == 1


def test_facts_in_arrays_and_texts(tmp_path, series):
    path = tmp_path / "a.npz"
    y, u = series
    np.savez(path, y=y, u=u, unit="nm", frame_rate_hz=np.array([RATE]), delay_frames="2")
    seen = lbt.load_record(path)
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, 2.0)
    np.savez(path, y=y, u=u, unit="nm", frame_rate_hz="500 Hz", delay_frames="a few")
    seen = lbt.load_record(path)
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, None)
    assert "delay_frames was not taken for delay_frames: 'a few' is no number" in seen.notes
    comments = ("frame rate = 500 Hz", "unit: nm", "delay frames: two")
    seen = lbt.load_record(csv(tmp_path / "b.csv", comments, y=y[:, 0], u=u[:, 0]))
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, None)


def table_of(text):
    """Names of the columns of a text table, and its values."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.csv"
        path.write_text(text, newline="")
        columns = read_contents(path).columns
    values = np.column_stack([column.values for column in columns])
    return [column.name for column in columns], values


@settings(max_examples=40)
@given(
    rows=st.lists(
        st.tuples(*[st.one_of(st.none(), st.floats(allow_nan=False, allow_infinity=False))] * 3),
        min_size=1,
        max_size=8,
    ),
    sign=st.sampled_from([",", ";", "\t", "|"]),
    heading=st.booleans(),
)
def test_any_table_comes_back(rows, sign, heading):
    head = [sign.join(["alpha", "beta", "gamma"])] if heading else []
    lines = [sign.join("" if v is None else repr(v) for v in row) for row in rows]
    names, values = table_of("\n".join(head + lines))
    expected = np.array([[np.nan if v is None else v for v in row] for row in rows])
    assert np.array_equal(values, expected, equal_nan=True)
    assert names == (["alpha", "beta", "gamma"] if heading else [""] * 3)


def test_headings_in_comments_and_cells_that_are_no_numbers():
    names, values = table_of("# time_s y_nm\n0.0 1.5\n0.1 -\n")
    assert names == ["time_s", "y_nm"]
    np.testing.assert_array_equal(values, [[0.0, 1.5], [0.1, np.nan]])
    names, values = table_of('# s = 1\n"y","remark"\n1,calm # dome\nNA,\n')
    assert names == ["y", "remark"]
    np.testing.assert_array_equal(values, [[1.0, np.nan], [np.nan, np.nan]])


def test_columns_say_which_record_a_file_holds(tmp_path, series):
    y, u = series
    pol = write_csv(tmp_path / "p.csv", ["pol_tip_nm", "pol_tilt_nm"], y.T)
    seen = lbt.load_record(pol, frame_rate_hz=RATE)
    assert seen.commands is None
    assert np.array_equal(seen.pseudo_open_loop(), y)
    both = write_csv(tmp_path / "b.csv", ["y_nm", "u_nm", "pol_nm"], [*y.T, u[:, 0]])
    with pytest.raises(ProblemError, match=r"got measurements \(y_nm\); commands .*Choose by col"):
        lbt.load_record(both, frame_rate_hz=RATE)
    seen = lbt.load_record(both, columns={"open_loop": "pol_nm"}, frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, u[:, :1])
    assert "not used: y_nm, u_nm" in seen.notes
    seen = lbt.load_record(both, columns={"commands": "u_nm"}, frame_rate_hz=RATE)
    assert np.array_equal(seen.commands, y[:, 1:])


def test_columns_are_chosen(tmp_path, series):
    y, u = series
    path = write_csv(
        tmp_path / "a.csv", ["a", "b", "c", "d", "stamp"], [*y.T, *u.T, np.arange(60) / RATE]
    )
    choice = {"measurements": ["a", 1], "commands": ("C", "d"), "times": "stamp"}
    known = {"unit": "mas", "diameter_m": 8, "command_unit": "nm", "frame_rate_hz": RATE}
    seen = lbt.load_record(path, columns=choice, **known)
    assert np.allclose(seen.measurements, lbt.models.nm_per_mas(8) * y)
    assert np.array_equal(seen.commands, u)
    assert "stamp was taken for seconds" in seen.notes
    one = lbt.load_record(path, columns={"open_loop": "b"}, unit="nm", frame_rate_hz=RATE)
    assert np.array_equal(one.measurements[:, 0], y[:, 1])
    assert "not used: a, c, d, stamp" in one.notes


def test_axes_of_many_columns_and_arrays_without_numbers(tmp_path):
    y, u = np.random.default_rng(0).standard_normal((2, 60, 5))
    for name, measurements in (("a", y), ("i", y + 1j), ("t", np.full(y.shape, "text"))):
        np.savez(tmp_path / f"{name}.npz", measurements=measurements, u=u, fs=RATE)

    def load(name, axes=None):
        return partial(lbt.load_record, tmp_path / f"{name}.npz", unit="nm", axes=axes)

    no_series = r"measurements is no series of real numbers; it was le"
    require_refusals(
        [
            (load("a"), ProblemError, "5 columns of measurements; say which.*axes="),
            (load("a", (0, 5)), ProblemError, "axes must be one or two different numbers below 5"),
            (load("i"), ProblemError, no_series),
            (load("t"), ProblemError, no_series),
        ]
    )
    seen = load("a", (3, 1))()
    assert np.array_equal(seen.measurements, y[:, [3, 1]])
    assert np.array_equal(seen.commands, u[:, [3, 1]])


def test_x_and_y_may_be_a_clock_and_its_series(tmp_path, series):
    y, u = series
    path = csv(tmp_path / "a.csv", x_nm=y[:, 0], y_nm=y[:, 1])
    with pytest.raises(ProblemError, match=r"got measurements \(x_nm, y_nm\)\. Choose by columns="):
        lbt.load_record(path, frame_rate_hz=RATE)
    for chosen, axes in ((("x_nm", "y_nm"), [0, 1]), ("y_nm", [1])):
        seen = lbt.load_record(path, columns={"open_loop": chosen}, frame_rate_hz=RATE)
        assert np.array_equal(seen.measurements, y[:, axes])
    both = csv(tmp_path / "b.csv", yy_nm=y[:, 1], yx_nm=y[:, 0], ux_nm=u[:, 0], uy_nm=u[:, 1])
    seen = lbt.load_record(both, frame_rate_hz=RATE)
    assert np.array_equal(np.hstack([seen.measurements, seen.commands]), np.hstack([y, u]))


def test_a_remark_is_no_series_and_refuses_no_file(tmp_path):
    path, known = tmp_path / "a.csv", {"frame_rate_hz": RATE, "delay_frames": 1}
    path.write_text("y_nm,u_nm,remark\n" + "".join(f"{k % 7},{k % 5},calm\n" for k in range(60)))
    seen = lbt.load_record(path, **known)
    assert seen.frames == 60
    assert "not used: remark" in seen.notes
    remark = {"measurements": "y_nm", "commands": "remark"}
    assert not lbt.load_record(path, columns=remark, unit="nm", **known).usable.any()


@pytest.fixture(scope="module")
def recorded():
    """Measurements and commands of a loop at 1 kHz, (3000, 2) each."""
    return integrator_loop(lines=((31.0, 0.004, 60.0),), frames=3002, axes=2)


def write_hdf5(path, arrays, *, matlab=False, **facts):
    """Arrays and facts in HDF5; of MATLAB 7.3 behind its block of text, columns first."""
    with h5py.File(path, "w", userblock_size=512 if matlab else 0) as file:
        for name, array in arrays.items():
            file[name] = array.T if matlab else array
        for name, value in facts.items():
            if matlab:
                text = isinstance(value, str)
                file[name] = np.array([[ord(c)] for c in value], "u2") if text else [[value]]
            else:
                file.attrs[name] = value
        for item in file.values() if matlab else ():
            item.attrs["MATLAB_class"] = np.bytes_("char" if item.dtype == "u2" else "double")
    if matlab:
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(10) + b"\2IM")
    return path


FACTS = {"frame_rate_hz": 1000.0, "delay_frames": 1.0, "unit": "nm"}
FORMATS = ["npz", "h5", "mat", "mat 7.3", "sav", "fits", "sparta"]


def written(folder, form, y, u):
    """Write a record in a format, with its facts where the format has a place for them."""
    path, arrays = folder / f"a.{form.split()[0]}", {"y": y, "u": u}
    if form == "npz":
        np.savez(path, **arrays, **FACTS)
    elif form == "h5":
        write_hdf5(path, {"night/y": y, "night/u": u}, **FACTS)
        with h5py.File(path, "a") as file:
            file["night/y"].attrs["unit"] = "nm"
            file["night/u"].attrs["units"] = np.bytes_("nm")
    elif form == "mat":
        scipy.io.savemat(path, {"rec": {**arrays, **FACTS, "unit": "nm"}})
    elif form == "mat 7.3":
        write_hdf5(path, arrays, matlab=True, **FACTS)
    elif form == "sav":
        write_sav(path, **arrays, **FACTS)
    elif form == "fits":
        columns = [fits.Column(n, "2D", array=a, unit="nm") for n, a in arrays.items()]
        table(path, *columns, FPS=1000.0, DELAYFRM=1.0)
    else:
        seconds = 1.7e9 + np.arange(len(y)) / 1000
        path = sparta_table(folder / "a.fits", y, u, seconds=seconds, rate=1000.0)
    return path


@pytest.fixture(scope="module")
def model(recorded, tmp_path_factory):
    path = written(tmp_path_factory.mktemp("npz"), "npz", *recorded)
    return lbt.identification.identify(lbt.load_record(path), sensor_gain=0.6)


def same(one, other):
    """Whether two results hold the same to the bit."""
    if dataclasses.is_dataclass(one):
        names = [f.name for f in dataclasses.fields(one) if f.name not in ("notes", "source")]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return one == other or (one != one and other != other)


@pytest.mark.parametrize("form", FORMATS[1:])
def test_every_format_gives_the_same_model(tmp_path, recorded, model, form):
    path = written(tmp_path, form, *recorded)
    more = {}
    if form == "sparta":
        more = {"columns": {"measurements": "Gradients"}, "unit": "nm", "delay_frames": 1}
    seen = lbt.load_record(path, **more)
    assert np.array_equal(seen.measurements, recorded[0])
    assert np.array_equal(seen.commands, recorded[1])
    assert same(lbt.identification.identify(seen, sensor_gain=0.6), model)


def test_the_comparison_sees_a_change_of_one_bit(tmp_path, recorded, model):
    y, u = recorded
    moved = y.copy()
    moved[1500, 1] = np.nextafter(moved[1500, 1], np.inf)
    seen = lbt.load_record(written(tmp_path, "npz", moved, u))
    assert not same(lbt.identification.identify(seen, sensor_gain=0.6), model)


def test_groups_and_structures_stand_before_their_arrays(tmp_path, series):
    y, u = series
    path = write_hdf5(tmp_path / "a.h5", {"one/y": y, "one/u": u, "two/y": u, "two/u": y}, fs=RATE)
    with h5py.File(path, "a") as file:
        file["remarks"] = ["calm"] * 60
    with pytest.raises(
        ProblemError, match=r"one/y\[0\], one/y\[1\], two/y\[0\], two/y\[1\] are all"
    ):
        lbt.load_record(path, unit="nm")
    chosen = {"measurements": "two/y", "commands": ["one/u[1]", "one/u[0]"]}
    seen = lbt.load_record(path, columns=chosen, unit="nm", axes=(1, 0))
    assert np.array_equal(seen.measurements, u[:, ::-1])
    assert np.array_equal(seen.commands, u)
    assert "remarks is no series of real numbers; it was left out" in seen.notes
    cell = np.array([np.zeros(3), np.zeros((2, 2)), "calm"], dtype=object)
    scipy.io.savemat(tmp_path / "b.mat", {"night": {"dome": {"y": y}}, "u": u, "cell": cell})
    seen = lbt.load_record(tmp_path / "b.mat", frame_rate_hz=RATE, unit="nm")
    assert np.array_equal(seen.measurements, y)
    assert "measurements: night.dome.y[0], night.dome.y[1]" in seen.notes
    assert "cell is no series of real numbers; it was left out" in seen.notes
    rows = np.array(
        [(y, RATE)], dtype=[("POL", object), ("FS", float)]
    )  # as scipy gives one of IDL
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scipy.io.readsav", lambda *_, **__: {"night": rows.view(np.recarray)})
        (tmp_path / "c.sav").touch()
        seen = lbt.load_record(tmp_path / "c.sav", unit="nm")
    assert np.array_equal(seen.measurements, y)
    assert seen.frame_rate_hz == RATE


def test_matlab_keeps_its_cells_elsewhere_and_its_columns_first(tmp_path):
    square = np.array([[1.0, 4.0], [3.0, 5.0]])  # of two frames: no longer side tells them
    path = write_hdf5(tmp_path / "a.mat", {"y": square}, matlab=True, fs=RATE)
    with h5py.File(path, "a") as file:
        file["#refs#/y"] = np.ones(7)
    columns = {column.name: column.values.tolist() for column in read_contents(path).columns}
    assert columns == {"y[0]": [1, 3], "y[1]": [4, 5]}


def test_what_is_in_another_file_is_not_opened(tmp_path, series):
    y, _ = series
    other, path = tmp_path / "other.h5", tmp_path / "a.h5"
    write_hdf5(other, {"pol": y})
    y.tofile(tmp_path / "raw")
    layout = h5py.VirtualLayout(shape=y.shape, dtype="f8")
    layout[:] = h5py.VirtualSource(other, "pol", shape=y.shape)
    with h5py.File(path, "w") as file:
        file["linked"] = h5py.ExternalLink(other, "/pol")
        file.create_virtual_dataset("virtual", layout)
        raw = [(tmp_path / "raw", 0, y.nbytes)]
        file.create_dataset("raw", y.shape, dtype="f8", external=raw)
    contents = read_contents(path)
    assert contents.columns == []
    left_out = "is no series of real numbers; it was left out"
    assert contents.notes == [f"raw {left_out}", f"virtual {left_out}"]


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_file_of_idl(tmp_path):
    """Which scipy leaves open."""
    (tmp_path / "a.sav").write_bytes(b"SR\0\4\0")
    with pytest.raises(TelemetryError, match=r"cannot read .*a\.sav as \.sav"):
        lbt.load_record(tmp_path / "a.sav")
    gc.collect()


def test_without_h5py_it_says_what_to_install(tmp_path, series, monkeypatch):
    path = write_hdf5(tmp_path / "a.h5", {"pol": series[0]})
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(
        TelemetryError, match=r'a\.h5 as \.h5: it needs h5py: pip install "lbt-synth\[hdf5\]"'
    ):
        lbt.load_record(path)


def test_times_of_sparta(tmp_path, series):
    """Seconds and microseconds belong together; times that are all zero are none beside a rate."""
    y, u = series
    seconds = 1.7e9 + 0.9 + np.delete(np.arange(62), [20, 21]) / RATE
    path = sparta_table(tmp_path / "a.fits", y, u, seconds=seconds, rate=RATE)
    read = {"columns": {"measurements": "Gradients", "frame_numbers": ()}, "unit": "nm"}
    seen = lbt.load_record(path, **read)
    assert np.flatnonzero(~seen.measured).tolist() == [20, 21]
    assert "times: Seconds + USeconds" in seen.notes
    assert "not used: FrameCounter, HODM_Positions[0] to HODM_Positions[59]" in seen.notes
    bare = sparta_table(tmp_path / "b.fits", y, u, seconds=np.zeros(60), rate=RATE)
    seen = lbt.load_record(bare, **read)
    assert (seen.frame_rate_hz, seen.frames) == (RATE, 60)
    assert "Seconds + USeconds is zero in all rows and was left out" in seen.notes
    bare = sparta_table(tmp_path / "c.fits", y, u, seconds=np.zeros(60))
    with pytest.raises(ProblemError, match=r"times_s must rise from row to row; all rows have 0"):
        lbt.load_record(bare, **read)
    assert lbt.load_record(bare, frame_rate_hz=RATE, **read).frames == 60
