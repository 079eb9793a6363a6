"""What files of every format hold, damage, and which columns make a record."""

import gc
import sys
from functools import partial

import h5py
import numpy as np
import pytest
import scipy.io
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st
from support.record_files import csv, hdus, image, sparta_table, write_csv, write_sav
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification.records.columns import (
    clock_factor,
    nm_unit,
    parse_column,
    unit_to_show,
)
from lbt_synth.identification.records.contents import read_contents

RATE = 500.0
LEFT_OUT = "is no series of real numbers; it was left out"


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # scipy leaves damaged files of IDL open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage(tmp_path):
    for name, content, words in (
        ("a.sav", b"SR\0\4\0", r"cannot read .*a\.sav as \.sav"),
        ("a.xls", b"", r"a record must end in \.fits, .*got 'a\.xls'"),
        ("a.csv", b"", "has no rows"),
        ("a.csv", b"y_nm,u_nm\n", "a heading and no rows"),
        ("a.csv", b"y_nm,u_nm\n1,2\n3\n", "line 3 must have 2 cells; got 1"),
        ("a.csv", b"y;u\n1,5;2,5\n;1\n2;-1,5\n,5;0\n", "2 cells of y are no .* '1,5' in line 2"),
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
    gc.collect()


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


def table(path, *columns, **cards):
    unit = fits.BinTableHDU.from_columns(columns)
    unit.header.update(cards)
    return hdus(path, unit)


FACTS, DELAY = {"frame_rate_hz": RATE, "delay_frames": 2.0, "unit": "nm"}, {"delay_frames": 2}
FORMATS = {  # and what they do not tell
    "npy": FACTS | {"columns": {"measurements": (0, 1), "commands": (2, 3)}},
    "sparta.fits": DELAY | {"columns": {"measurements": "Gradients"}, "unit": "nm"},
    **dict.fromkeys(["csv", "blanks.csv", "images.fits", "table.fits", "npz"], DELAY),
    **{form: {} for form in ("h5", "mat", "v7.3.mat", "sav")},
}


def write_record(path, form, y, u):
    arrays, time_s = {"y": y, "u": u}, np.arange(60) / RATE
    if form.endswith("csv"):
        names = ["time_s", "y0_nm", "y1_nm", "u0_nm", "u1_nm"]
        write_csv(path, names, [time_s, *y.T, *u.T], sign="," if form == "csv" else " ")
    elif form == "images.fits":  # turned
        commands = image("COMMANDS", u.T.astype(">f8"), "nm")
        hdus(path, image("RESIDUALS", y.T, "nm"), commands, FRAMRATE=RATE)
    elif form == "table.fits":
        series = {"Residuals": y, "Commands": u}
        columns = [fits.Column(n, "2D", array=a, unit="nm") for n, a in series.items()]
        table(path, fits.Column("TIME", "D", array=time_s, unit="s"), *columns)
    elif form == "sparta.fits":
        sparta_table(path, y, u, seconds=1.7e9 + time_s, rate=RATE)
    elif form == "npz":
        np.savez(path, measurements=y, commands=u.T, frame_rate_hz=RATE, unit="nm")
    elif form == "npy":
        np.save(path, np.hstack([y, u]))
    elif form == "h5":
        write_hdf5(path, {"night/y": y, "night/u": u}, **FACTS)
        with h5py.File(path, "a") as file:
            file["night/y"].attrs["unit"] = "nm"
            file["night/u"].attrs["units"] = np.bytes_("nm")
    elif form == "mat":
        scipy.io.savemat(path, {"rec": arrays | FACTS})
    elif form == "v7.3.mat":
        write_hdf5(path, arrays, matlab=True, **FACTS)
    else:
        write_sav(path, **arrays, **FACTS)


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_gives_the_same_record(tmp_path, series, form):
    path = tmp_path / f"a.{form}"
    write_record(path, form, *series)
    seen = lbt.load_record(path, **FORMATS[form])
    assert isinstance(seen, lbt.identification.LoopRecord)
    assert np.array_equal([seen.measurements, seen.commands], series)
    assert (seen.frame_rate_hz, seen.delay_frames, seen.source) == (RATE, 2.0, str(path))
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1]
    assert {"measurements", "commands"} <= {note.partition(":")[0] for note in seen.notes}


def test_nulls_of_scaled_columns_and_images(tmp_path):
    raw = np.random.default_rng(0).integers(-1000, 1000, 60).astype(np.int16)
    raw[10], raw[11] = -999, -998
    unsigned = (raw.astype(int) + 32768).astype(np.uint16)
    column = partial(fits.Column, "POL", "I", null=-999, unit="nm")
    scaled = table(tmp_path / "a.fits", column(array=raw), TSCAL1=0.01, TZERO1=3.0, FPS=RATE)
    shifted = table(tmp_path / "b.fits", column(array=unsigned, bzero=32768), FPS=RATE)
    files = [(scaled, None), (shifted, None)]
    for name, array in (("c.fits", raw), ("d.fits", unsigned)):
        picture = fits.PrimaryHDU(np.column_stack([array, array]))
        picture.header.update({"BUNIT": "nm", "FPS": RATE})
        picture.writeto(tmp_path / name)
        fits.setval(tmp_path / name, "BLANK", value=-999)
        files.append((tmp_path / name, {"open_loop": (0, 1)}))
    for path, chosen in files:
        seen = lbt.load_record(path, columns=chosen)
        assert np.flatnonzero(~seen.usable).tolist() == [10]
    assert lbt.load_record(scaled).measurements[11, 0] == pytest.approx(3 - 9.98)


def test_a_name_and_a_header_of_two_units(tmp_path, series):
    mas, nm = (
        table(tmp_path / f"{unit}.fits", fits.Column(f"POL_{unit}", "D", unit="NM", array=y))
        for unit, y in zip(("mas", "nm"), series[0].T, strict=True)
    )
    words = "POL_mas has the unit 'NM' in the header"
    refused(lambda: lbt.load_record(mas, diameter_m=8), TelemetryError, words)
    assert lbt.load_record(nm, frame_rate_hz=RATE).axes == 1


def test_facts_in_arrays_and_texts(tmp_path, series):
    y, u = series
    for facts, delay in (
        ({"frame_rate_hz": np.array([RATE]), "delay_frames": "2"}, 2.0),
        ({"frame_rate_hz": "500 Hz", "delay_frames": "a few"}, None),
    ):
        np.savez(tmp_path / "a.npz", y=y, u=u, unit="nm", **facts)
        seen = lbt.load_record(tmp_path / "a.npz")
        assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, delay)
    assert "delay_frames was not taken for delay_frames: 'a few' is no number" in seen.notes
    comments = ("frame rate = 500 Hz", "unit: nm", "delay frames: two")
    seen = lbt.load_record(csv(tmp_path / "b.csv", comments, y=y[:, 0], u=u[:, 0]))
    assert (seen.frame_rate_hz, seen.delay_frames) == (RATE, None)


def table_of(folder, text):
    """Names of the columns of a text table, and its values."""
    (path := folder / "a.csv").write_text(text, newline="")
    columns = read_contents(path).columns
    return [c.name for c in columns], np.column_stack([c.values for c in columns])


@given(
    rows=st.lists(
        st.tuples(*[st.one_of(st.none(), st.floats(allow_nan=False, allow_infinity=False))] * 3),
        min_size=1,
        max_size=8,
    ),
    sign=st.sampled_from([",", ";", "\t", "|"]),
    heading=st.booleans(),
)
def test_any_table_comes_back(tmp_path_factory, rows, sign, heading):
    head = [sign.join(["alpha", "beta", "gamma"])] if heading else []
    lines = [sign.join("" if v is None else repr(v) for v in row) for row in rows]
    names, values = table_of(tmp_path_factory.getbasetemp(), "\n".join(head + lines))
    assert np.array_equal(values, np.array(rows, dtype=float), equal_nan=True)
    assert names == (["alpha", "beta", "gamma"] if heading else [""] * 3)


def test_headings_in_comments_and_cells_that_are_no_numbers(tmp_path):
    names, values = table_of(tmp_path, "# time_s y_nm\n0.0 1.5\n0.1 -\n")
    assert names == ["time_s", "y_nm"]
    np.testing.assert_array_equal(values, [[0.0, 1.5], [0.1, np.nan]])
    names, values = table_of(tmp_path, '# s = 1\n"y","remark"\n1,calm # dome\nNA,\n')
    assert names == ["y", "remark"]
    np.testing.assert_array_equal(values, [[1.0, np.nan], [np.nan, np.nan]])


def test_columns_say_which_record_a_file_holds(tmp_path, series):
    y, u = series
    load = partial(lbt.load_record, frame_rate_hz=RATE)
    seen = load(write_csv(tmp_path / "p.csv", ["pol_tip_nm", "pol_tilt_nm"], y.T))
    assert seen.commands is None
    assert np.array_equal(seen.pseudo_open_loop(), y)
    both = write_csv(tmp_path / "b.csv", ["y_nm", "u_nm", "pol_nm"], [*y.T, u[:, 0]])
    seen = load(both, columns={"open_loop": "pol_nm"})
    assert np.array_equal(seen.measurements, u[:, :1])
    assert "not used: y_nm, u_nm" in seen.notes
    seen = load(both, columns={"commands": "u_nm"}, unit="nanometer")
    assert np.array_equal(seen.commands, y[:, 1:])
    # x and y may be a clock and its series
    plain = csv(tmp_path / "x.csv", x_nm=y[:, 0], y_nm=y[:, 1])
    for chosen, axes in ((("x_nm", "y_nm"), [0, 1]), ("y_nm", [1])):
        assert np.array_equal(load(plain, columns={"open_loop": chosen}).measurements, y[:, axes])
    crossed = csv(tmp_path / "c.csv", yy_nm=y[:, 1], yx_nm=y[:, 0], ux_nm=u[:, 0], uy_nm=u[:, 1])
    seen = load(crossed)
    assert np.array_equal([seen.measurements, seen.commands], series)


def test_columns_are_chosen(tmp_path, series):
    y, u = series
    columns = [*y.T, *u.T, np.arange(60) / RATE]
    path = write_csv(tmp_path / "a.csv", ["a", "b", "c", "d", "stamp"], columns)
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

    rows = [
        (load("a"), "5 columns of measurements; say which.*axes="),
        (load("a", (0, 5)), "axes must be one or two different numbers below 5"),
        (load("i"), f"measurements {LEFT_OUT}"),
        (load("t"), f"measurements {LEFT_OUT}"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)
    seen = load("a", (3, 1))()
    assert np.array_equal([seen.measurements, seen.commands], [y[:, [3, 1]], u[:, [3, 1]]])


def test_a_remark_is_no_series_and_refuses_no_file(tmp_path):
    path, known = tmp_path / "a.csv", {"frame_rate_hz": RATE, "delay_frames": 1}
    path.write_text("y_nm,u_nm,remark\n" + "".join(f"{k % 7},{k % 5},calm\n" for k in range(60)))
    seen = lbt.load_record(path, **known)
    assert seen.frames == 60
    assert "not used: remark" in seen.notes
    remark = {"measurements": "y_nm", "commands": "remark"}
    assert not lbt.load_record(path, columns=remark, unit="nm", **known).usable.any()


def test_groups_and_structures_stand_before_their_arrays(tmp_path, series):
    y, u = series
    path = write_hdf5(tmp_path / "a.h5", {"one/y": y, "one/u": u, "two/y": u, "two/u": y}, fs=RATE)
    with h5py.File(path, "a") as file:
        file["remarks"] = ["calm"] * 60
    words = r"one/y\[0\], one/y\[1\], two/y\[0\], two/y\[1\] are all"
    refused(lambda: lbt.load_record(path, unit="nm"), ProblemError, words)
    chosen = {"measurements": "two/y", "commands": ["one/u[1]", "one/u[0]"]}
    seen = lbt.load_record(path, columns=chosen, unit="nm", axes=(1, 0))
    assert np.array_equal([seen.measurements, seen.commands], [u[:, ::-1], u])
    assert f"remarks {LEFT_OUT}" in seen.notes
    cell = np.array([np.zeros(3), np.zeros((2, 2)), "calm"], dtype=object)
    scipy.io.savemat(tmp_path / "b.mat", {"night": {"dome": {"y": y}}, "u": u, "cell": cell})
    seen = lbt.load_record(tmp_path / "b.mat", frame_rate_hz=RATE, unit="nm")
    assert np.array_equal(seen.measurements, y)
    assert {"measurements: night.dome.y[0], night.dome.y[1]", f"cell {LEFT_OUT}"} < {*seen.notes}
    # as scipy gives a structure of IDL
    rows = np.array([(y, RATE)], dtype=[("POL", object), ("FS", float)])
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
    y, path = series[0], tmp_path / "a.h5"
    other = write_hdf5(tmp_path / "other.h5", {"pol": y})
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
    assert contents.notes == [f"raw {LEFT_OUT}", f"virtual {LEFT_OUT}"]


def test_without_h5py_it_says_what_to_install(tmp_path, series, monkeypatch):
    path = write_hdf5(tmp_path / "a.h5", {"pol": series[0]})
    monkeypatch.setitem(sys.modules, "h5py", None)
    words = r'a\.h5 as \.h5: it needs h5py: pip install "lbt-synth\[hdf5\]"'
    refused(lambda: lbt.load_record(path), TelemetryError, words)


def test_times_of_sparta(tmp_path, series):
    """Seconds and microseconds belong together; times that are all zero are none beside a rate."""
    seconds = 1.7e9 + 0.9 + np.delete(np.arange(62), [20, 21]) / RATE
    path = sparta_table(tmp_path / "a.fits", *series, seconds=seconds, rate=RATE)
    read = {"columns": {"measurements": "Gradients", "frame_numbers": ()}, "unit": "nm"}
    seen = lbt.load_record(path, **read)
    assert np.flatnonzero(~seen.measured).tolist() == [20, 21]
    assert "times: Seconds + USeconds" in seen.notes
    assert "not used: FrameCounter, HODM_Positions[0] to HODM_Positions[59]" in seen.notes
    bare = sparta_table(tmp_path / "b.fits", *series, seconds=np.zeros(60), rate=RATE)
    seen = lbt.load_record(bare, **read)
    assert (seen.frame_rate_hz, seen.frames) == (RATE, 60)
    assert "Seconds + USeconds is zero in all rows and was left out" in seen.notes
    bare = sparta_table(tmp_path / "c.fits", *series, seconds=np.zeros(60))
    words = r"times_s must rise from row to row; all rows have 0"
    refused(lambda: lbt.load_record(bare, **read), ProblemError, words)
    assert lbt.load_record(bare, frame_rate_hz=RATE, **read).frames == 60


NAMES = {
    "y_tip [nm]": ("measurements", 0, "nm"),
    "Residual (nm)": ("measurements", None, "nm"),
    "tilt_nm": ("measurements", 1, "nm"),
    "measurement 2 [nm]": ("measurements", 2, "nm"),
    "tip_command_um": ("commands", 0, "um"),
    "pol_tip_nm": ("open_loop", 0, "nm"),
    "disturbance_x [nm]": ("open_loop", 0, "nm"),
    "psd (nm^2/Hz)": ("density", None, "nm^2/Hz"),
    "asd [nm/sqrt(Hz)]": ("density", None, "nm/sqrt(Hz)"),
    "psd_nm2_hz": ("density", None, "nm2_hz"),
    "asd_mas_rthz": ("density", None, "mas_rthz"),
    "timestamp_ms": ("times", None, "ms"),
    "y [mas (rms)]": ("measurements", None, "mas (rms)"),
    "y nm]": (None, None, None),
    "y []": ("measurements", None, None),
    "y_a": (None, None, None),  # a is a year, and the name of an axis
    "f_mhz": (None, None, None),  # of mHz or of MHz
}


def test_role_axis_and_unit():
    columns = {name: parse_column(name, np.zeros(3)) for name in NAMES}
    assert {name: (c.role, c.axis, c.unit) for name, c in columns.items()} == NAMES


@pytest.mark.parametrize(
    ("unit", "kind", "power", "factor"),
    [
        ("nm", "loop", 0, 1.0),
        ("nanometers", "loop", 0, 1.0),
        ("µm", "loop", 0, 1e3),
        ("m", "loop", 0, 1e9),
        ("mas", "loop", 0, 9.96292),
        ("urad", "loop", 0, 2055.0),  # D/4 = 2.055 m a radian
        ("rad", "loop", 0, 2.055e9),
        ("um^2/Hz", "spectrum", 2, 1e6),
        ("mas2/hz", "spectrum", 2, 9.96292**2),
        ("mas_rthz", "spectrum", 1, 9.96292),
        ("um / √Hz", "spectrum", 1, 1e3),
    ],
)
def test_units_of_wavefront(unit, kind, power, factor):
    parsed = nm_unit(unit, diameter_m=8.22, kind=kind)
    assert (parsed.power, parsed.factor) == (power, pytest.approx(factor, rel=1e-5))
    if "m" not in unit.lower().replace("mas", ""):
        refused(lambda: nm_unit(unit, kind=kind), ProblemError, "give diameter_m")


def test_people_see_a_wavefront_in_the_unit_of_its_data_or_the_nearest_one():
    seen = {"nm": "nm", "m": "nm", "um": "um", "MAS": "mas", "arcsec": "mas", "urad": "urad"}
    seen |= {"mas^2/Hz": "mas", "nm_rthz": "nm", "rad": "mas"}
    assert {unit: unit_to_show(unit) for unit in seen} == seen


def test_units_of_clocks():
    factors = {None: 1.0, "ms": 1e-3, "us": 1e-6, "d": 86_400.0}
    assert {unit: clock_factor(unit, "s") for unit in factors} == factors
    factors = {None: 1.0, "mHz": 1e-3, "MHz": 1e6, "khz": 1e3, "HZ": 1.0}
    assert {unit: clock_factor(unit, "Hz") for unit in factors} == factors


def test_what_is_no_unit():
    words = "unit must be one of nm, um, m of wavefront, or m"
    for unit in ("volt", "s", "nm2", "nm^2/Hz", "", 5):
        refused(partial(nm_unit, unit, diameter_m=8.22), ProblemError, words)
    for unit, base in (("mhz", "Hz"), ("Hz", "s"), ("nm", "s")):
        words = f"must be in one of .*; got '{unit}'"
        refused(partial(clock_factor, unit, base), ProblemError, words)
