"""Commands on records without noise and on files with odd names."""

from __future__ import annotations

import time

import numpy as np
from support.commands import run
from support.recorded_loops import spliced_record


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
    record = spliced_record(frames=6000)
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
