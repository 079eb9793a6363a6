"""Columns chosen by their names, their axes, or the call."""

import numpy as np
import pytest
from support.record_files import csv, write_csv

import lbt_synth as lbt
from lbt_synth.errors import ProblemError

RATE = 500.0


@pytest.mark.parametrize(
    ("names", "axes"),
    [
        (["y_nm"], 1),
        (["Y [nm]"], 1),
        (["Residual (nm)"], 1),
        (["tip_nm", "tilt_nm"], 2),
        (["tilt_nm", "tip_nm"], 2),
        (["slopes_tip_nm", "slopes_tilt_nm"], 2),
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
        (["open_loop_0_nm", "open_loop_1_nm"], None),
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


FRAMES = 60


def test_measurements_and_commands_are_of_the_same_axes(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    path = csv(tmp_path / "a.csv", tilt_nm=y, tip_cmd_nm=u)
    with pytest.raises(ProblemError, match="of the same axes; got tilt_nm with tip_cmd_nm"):
        lbt.load_record(path, frame_rate_hz=RATE)
    chosen = {"measurements": "tilt_nm", "commands": "tip_cmd_nm"}
    assert lbt.load_record(path, frame_rate_hz=RATE, columns=chosen).axes == 1
    one = csv(tmp_path / "b.csv", y_1_nm=y, y_2_nm=u, u_0_nm=y, u_1_nm=u)  # counted from 1
    assert np.array_equal(lbt.load_record(one, frame_rate_hz=RATE).commands, np.c_[y, u])
    mine = csv(tmp_path / "y.csv", tilt_nm=y)
    np.save(tmp_path / "u.npy", u)
    seen = lbt.load_record(mine, commands=tmp_path / "u.npy", frame_rate_hz=RATE, unit="nm")
    assert np.array_equal(seen.commands[:, 0], u)


def test_x_and_y_may_be_a_clock_and_its_series(tmp_path, series):
    y, u = series
    path = csv(tmp_path / "a.csv", x_nm=y[:, 0], y_nm=y[:, 1])
    clock = csv(tmp_path / "c.csv", x=np.arange(FRAMES), y_nm=y[:, 1])
    for each, names in ((path, "x_nm, y_nm"), (clock, "x, y_nm")):
        with pytest.raises(
            ProblemError, match=rf"{names} are all named as .*columns=\{{'\w+': \.\.\.\}}"
        ):
            lbt.load_record(each, kind="open_loop", frame_rate_hz=RATE)
    chosen = {"open_loop": ("x_nm", "y_nm")}
    seen = lbt.load_record(path, columns=chosen, frame_rate_hz=RATE)
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
