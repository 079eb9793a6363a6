"""Commands from a second file, matched by counters and times."""

import numpy as np
import pytest
from support.record_files import csv

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError

RATE = 500.0


def test_commands_from_another_file(tmp_path, series):
    y, u = series
    np.save(tmp_path / "y.npy", y)
    np.save(tmp_path / "u.npy", u)
    seen = lbt.load_record(
        tmp_path / "y.npy", commands=tmp_path / "u.npy", frame_rate_hz=RATE, unit="nm"
    )
    assert np.array_equal(seen.measurements, y)
    assert np.array_equal(seen.commands, u)
    assert f"commands are from {tmp_path / 'u.npy'}" in seen.health.notes
    np.save(tmp_path / "v.npy", u[:-1])
    with pytest.raises(TelemetryError, match="as many frames as the measurements; got 59, 60"):
        lbt.load_record(tmp_path / "y.npy", commands=tmp_path / "v.npy", unit="nm")
    with pytest.raises(TelemetryError, match="cannot read .*w.npy: No such file"):
        lbt.load_record(tmp_path / "y.npy", commands=tmp_path / "w.npy", unit="nm")


FRAMES = 60


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
    with pytest.raises(TelemetryError, match="only 0 of 60 measurements have a command"):
        lbt.load_record(mine, commands=far, frame_rate_hz=RATE)
    twice = csv(tmp_path / "t.csv", frame=np.arange(60) // 2 * 2, u_nm=u)
    with pytest.raises(TelemetryError, match="must rise from row to row to be matched"):
        lbt.load_record(mine, commands=twice, frame_rate_hz=RATE)
    back = csv(tmp_path / "b.csv", frame=np.arange(60)[::-1], u_nm=u)
    with pytest.raises(TelemetryError, match="of both files must rise, without gaps"):
        lbt.load_record(mine, commands=back, frame_rate_hz=RATE)


def test_two_files_are_laid_beside_each_other_by_their_times(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", time_s=np.arange(60) / RATE + 0.02, y_nm=y)
    theirs = csv(tmp_path / "u.csv", time_ms=np.arange(60) * 1e3 / RATE + 0.1, u_nm=u)
    seen = lbt.load_record(mine, commands=theirs, delay_frames=2)
    assert np.array_equal(seen.commands[:50, 0], u[10:])
    assert seen.frame_rate_hz == pytest.approx(RATE)
    between = csv(tmp_path / "b.csv", time_ms=np.arange(60) * 1e3 / RATE + 1.0, u_nm=u)
    with pytest.raises(TelemetryError, match="only 0 of 60 measurements have a command"):
        lbt.load_record(mine, commands=between)
    bare = csv(tmp_path / "n.csv", u_nm=u)
    seen = lbt.load_record(mine, commands=bare)
    assert np.array_equal(seen.commands[:, 0], u)
    assert any("no clock in common" in note for note in seen.health.notes)
    short = csv(tmp_path / "s.csv", u_nm=u[:-1])
    with pytest.raises(TelemetryError, match="as many frames as the measurements; got 59, 60"):
        lbt.load_record(mine, commands=short)


def test_both_files_tell_facts_and_each_its_own_unit(tmp_path, series):
    y, u = series[0][:, 0], series[1][:, 0]
    mine = csv(tmp_path / "y.csv", ("unit = mas", "diameter_m = 8.0"), y=y)
    slow = csv(tmp_path / "u.csv", ("frame_rate_hz = 250", "delay_frames = 2"), u_nm=u)
    with pytest.raises(ProblemError, match=r"must be that of .* in u\.csv, 250; got 500"):
        lbt.load_record(mine, commands=slow, frame_rate_hz=RATE)
    seen = lbt.load_record(mine, commands=slow)
    assert (seen.frame_rate_hz, seen.delay_frames) == (250.0, 2.0)
    assert np.allclose(seen.measurements[:, 0], lbt.models.nm_per_mas(8.0) * y)
    assert np.allclose(seen.commands[:, 0], u)
    silent = csv(tmp_path / "v.csv", u=u)
    with pytest.raises(ProblemError, match="nothing tells the unit of u; give command_unit"):
        lbt.load_record(mine, commands=silent, frame_rate_hz=RATE)
    with pytest.raises(ProblemError, match="command_unit must be one of nm, .*'V'.*volts .* scale"):
        lbt.load_record(mine, commands=silent, frame_rate_hz=RATE, command_unit="V")
    seen = lbt.load_record(mine, commands=silent, frame_rate_hz=RATE, command_unit="um")
    assert np.allclose(seen.commands[:, 0], 1e3 * u)
