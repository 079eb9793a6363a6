"""What files hold: nulls, facts in arrays and comments, damage.

Columns chosen by their names, their axes, or the call.
"""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from support.record_files import csv, write_csv
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
    path = tmp_path / "a.csv"
    path.write_text("y_nm,u_nm,remark\n" + "".join(f"{k % 7},{k % 5},calm\n" for k in range(60)))
    seen = lbt.load_record(path, frame_rate_hz=RATE, delay_frames=1)
    assert seen.frames == 60
    assert "not used: remark" in seen.notes
    remark = {"measurements": "y_nm", "commands": "remark"}
    seen = lbt.load_record(path, columns=remark, frame_rate_hz=RATE, unit="nm", delay_frames=1)
    assert not seen.usable.any()
