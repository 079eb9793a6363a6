"""What files hold: nulls, facts in arrays and comments, damage.

Columns chosen by their names, their axes, or the call.
"""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from support.record_files import csv, write_csv

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.contents import read_contents

RATE = 500.0


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.xls", b"", r"a record must end in \.fits, .*got 'a\.xls'"),
        ("a.csv", b"", "has no rows"),
        ("a.csv", b"y_nm,u_nm\n", "a heading and no rows"),
        ("a.csv", b"y_nm,u_nm\n1,2\n3\n", "line 3 must have 2 cells; got 1"),
        ("a.csv", b"# x\ny_nm,u_nm\n1,2\n3,up\n", "cell 2 of line 4 must be a number; got 'up'"),
        ("a.csv", b"\xff\xfe\x00", "not UTF-8 text"),
        ("a.npy", b"\x93NUMPY garbage", "cannot read .*a.npy as .npy"),
        ("a.npz", b"PK garbage", "cannot read .*a.npz as .npz"),
        ("a.fits", b"SIMPLE", "cannot read .*a.fits as .fits"),
        ("a.fits", b"", "cannot read .*a.fits as .fits"),
    ],
)
def test_damage(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(lbt.errors.TelemetryError, match=words) as caught:
        lbt.load_record(tmp_path / name, frame_rate_hz=RATE)
    assert "Traceback" not in str(caught.value)


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
    neither = "it begins as neither an NPY file nor a ZIP archive does"
    for name in ("a.npz", "a.npy"):
        for content in (b"", b"PK", b"garbage"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(lbt.errors.TelemetryError, match=neither) as caught:
                lbt.load_record(tmp_path / name)
            assert "pickle" not in str(caught.value)


def contents_of(text):
    """What a text table holds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.csv"
        path.write_text(text, newline="")
        return read_contents(path)


def table_of(text):
    """Names of the columns of a text table, its values, and notes."""
    found = contents_of(text)
    values = np.column_stack([column.values for column in found.columns])
    return [column.name for column in found.columns], values, found.notes


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
    names, values, _ = table_of("\n".join(head + lines))
    expected = np.array([[np.nan if v is None else v for v in row] for row in rows])
    assert np.array_equal(values, expected, equal_nan=True)
    assert names == (["alpha", "beta", "gamma"] if heading else [""] * 3)


def test_headings_in_comments_and_decimal_commas():
    names, _, _ = table_of("# time_s y_nm\n0.0 1.5\n0.1 2.5\n")
    assert names == ["time_s", "y_nm"]
    _, values, notes = table_of("t_s;y_nm\n0,5;1,25\n1,0;-2\n")
    assert values.tolist() == [[0.5, 1.25], [1.0, -2.0]]
    assert notes == ["commas were taken for decimal points"]


@pytest.mark.parametrize(
    ("names", "axes"),
    [
        (["y_nm"], 1),
        (["Residual (nm)"], 1),
        (["tilt_nm", "tip_nm"], 2),
        (["residual_x_nm", "residual_y_nm"], 2),
        (["measurement 1 [nm]", "measurement 2 [nm]"], 2),
        (["y1_nm", "y0_nm"], 2),
    ],
)
def test_names_of_measurements(tmp_path, series, names, axes):
    y, u = series
    commands = ["u_nm"] if axes == 1 else ["cmd_tip_nm", "cmd_tilt_nm"]
    path = write_csv(tmp_path / "a.csv", [*names, *commands], [*y.T[:axes], *u.T[:axes]])
    seen = lbt.load_record(path, frame_rate_hz=RATE)
    order = [1, 0] if names[0] in ("tilt_nm", "y1_nm") else [0, 1][:axes]
    assert np.array_equal(seen.measurements, y[:, order])
    assert np.array_equal(seen.commands, u[:, :axes])


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (["pol_tip_nm", "pol_tilt_nm"], None),
        (["disturbance_x [nm]", "disturbance_y [nm]"], None),
        (["y0_nm", "y1_nm"], "open_loop"),
    ],
)
def test_open_loops(tmp_path, series, names, kind):
    y, _ = series
    path = write_csv(tmp_path / "a.csv", names, y.T)
    seen = lbt.load_record(path, kind=kind, frame_rate_hz=RATE)
    assert seen.commands is None
    assert np.array_equal(seen.pseudo_open_loop(), y)
    assert seen.usable.all()


def test_measurements_alone_are_not_taken_for_an_open_loop(tmp_path, series):
    path = write_csv(tmp_path / "a.csv", ["y0_nm", "y1_nm"], series[0].T)
    with pytest.raises(ProblemError, match="Residuals of a closed loop need its commands"):
        lbt.load_record(path, frame_rate_hz=RATE)


@pytest.mark.parametrize("strange", [1j, "text"])
def test_an_array_that_holds_no_numbers_is_named(tmp_path, series, strange):
    y, u = series
    np.savez(tmp_path / "a.npz", measurements=np.full(y.shape, strange), commands=u, pol_nm=y)
    with pytest.raises(
        ProblemError,
        match=r"needs columns of measurements and commands; got .*"
        r"\(measurements holds no real numbers\)\. Choose by",
    ):
        lbt.load_record(tmp_path / "a.npz", kind="closed_loop", frame_rate_hz=RATE, unit="nm")
    seen = lbt.load_record(tmp_path / "a.npz", kind="open_loop", frame_rate_hz=RATE, unit="nm")
    assert "measurements holds no real numbers; it was left out" in seen.health.notes


def test_open_loop_and_commands(tmp_path, series):
    y, u = series
    path = write_csv(tmp_path / "a.csv", ["y_nm", "u_nm"], [y[:, 0], u[:, 0]])
    seen = lbt.load_record(path, kind="open_loop", frame_rate_hz=RATE)
    assert seen.commands is None
    assert "commands were left out: the record is of an open loop" in seen.health.notes
    both = write_csv(tmp_path / "b.csv", ["y_nm", "u_nm", "pol_nm"], [*y.T, u[:, 0]])
    with pytest.raises(ProblemError, match="more than one record; say kind: closed_loop or open_"):
        lbt.load_record(both, frame_rate_hz=RATE)
    assert lbt.load_record(both, kind="open_loop", frame_rate_hz=RATE).measurements[
        :, 0
    ] == pytest.approx(u[:, 0])


def test_columns_are_chosen(tmp_path, series):
    y, u = series
    path = write_csv(
        tmp_path / "a.csv", ["a", "b", "c", "d", "stamp"], [*y.T, *u.T, np.arange(60) / RATE]
    )
    choice = {"measurements": ["a", 1], "commands": ("C", "d"), "times": "stamp"}
    seen = lbt.load_record(path, columns=choice, unit="mas", diameter_m=8, command_unit="nm")
    assert np.allclose(seen.measurements, lbt.models.nm_per_mas(8) * y)
    assert np.array_equal(seen.commands, u)
    assert seen.frame_rate_hz == RATE
    one = lbt.load_record(path, columns={"open_loop": "b"}, unit="nm", frame_rate_hz=RATE)
    assert np.array_equal(one.measurements[:, 0], y[:, 1])
    assert "not used: a, c, d, stamp" in one.health.notes


def test_axes_of_many_columns(tmp_path):
    y, u = np.random.default_rng(0).standard_normal((2, 60, 5))
    path = tmp_path / "a.npz"
    np.savez(path, y=y, u=u, fs=RATE)
    with pytest.raises(ProblemError, match="5 columns of measurements; say which.*axes="):
        lbt.load_record(path, unit="nm")
    seen = lbt.load_record(path, unit="nm", axes=(3, 1))
    assert np.array_equal(seen.measurements, y[:, [3, 1]])
    assert np.array_equal(seen.commands, u[:, [3, 1]])
    with pytest.raises(ProblemError, match="axes must be one or two different numbers below 5"):
        lbt.load_record(path, unit="nm", axes=(0, 5))


def test_x_and_y_may_be_a_clock_and_its_series(tmp_path, series):
    y, u = series
    path = csv(tmp_path / "a.csv", x_nm=y[:, 0], y_nm=y[:, 1])
    clock = csv(tmp_path / "c.csv", x=np.arange(FRAMES), y_nm=y[:, 1])
    with pytest.raises(ProblemError, match=r"x, y_nm are all named as .*columns=\{'\w+': \.\.\.\}"):
        lbt.load_record(clock, kind="open_loop", frame_rate_hz=RATE)
    for chosen in ({"open_loop": ("x_nm", "y_nm")}, None):
        seen = lbt.load_record(path, kind="open_loop", columns=chosen, frame_rate_hz=RATE)
        assert np.array_equal(seen.measurements, y)
    seen = lbt.load_record(clock, columns={"open_loop": "y_nm"}, frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, y[:, 1:])
    both = csv(tmp_path / "b.csv", yy_nm=y[:, 1], yx_nm=y[:, 0], ux_nm=u[:, 0], uy_nm=u[:, 1])
    seen = lbt.load_record(both, frame_rate_hz=RATE)
    assert np.array_equal(seen.measurements, y)
    assert np.array_equal(seen.commands, u)


def test_a_clock_without_a_name_is_no_axis(tmp_path, series):
    path = tmp_path / "a.txt"
    np.savetxt(path, np.column_stack([np.arange(FRAMES) / RATE, series[0][:, 0]]))
    with pytest.raises(
        ProblemError,
        match=r"needs columns of open_loop; got a column.*columns=\{'open_loop': \.\.\.\}",
    ):
        lbt.load_record(path, kind="open_loop", unit="nm", frame_rate_hz=RATE)
    seen = lbt.load_record(path, columns={"times": 0, "open_loop": 1}, unit="nm")
    assert seen.frame_rate_hz == RATE
    np.savetxt(path, series[0])  # neither of these rises
    seen = lbt.load_record(path, kind="open_loop", unit="nm", frame_rate_hz=RATE)
    np.testing.assert_allclose(seen.measurements, series[0])


def test_a_text_that_nobody_uses_refuses_no_file(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("y_nm,u_nm,remark\n" + "".join(f"{k % 7},{k % 5},calm\n" for k in range(60)))
    seen = lbt.load_record(path, frame_rate_hz=RATE, delay_frames=1)
    assert seen.frames == 60
    assert "remark holds texts; it was left out" in seen.health.notes
    with pytest.raises(ProblemError, match="there is no column 'remark'"):
        lbt.load_record(path, columns={"commands": "remark"}, frame_rate_hz=RATE)
