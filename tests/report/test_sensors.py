"""The page of designs of several sensors."""

import hashlib

import pytest
from support.commands import run
from support.several_sensors import write_config

import lbt_synth as lbt
from lbt_synth.report.sensors import write_sensors_report


def test_a_page_has_the_table_of_failures_and_a_run(
    sensors_design, sensors_file, sensors_config, tmp_path
):
    files, found = write_sensors_report(
        sensors_config,
        {"both": sensors_design},
        tmp_path / "page.html",
        gain_files={"both": sensors_file},
    )
    text = files[0].read_text(encoding="utf-8")
    assert "When sensors fail" in text
    for source in (sensors_file, sensors_config.source):
        assert hashlib.sha256(source.read_bytes()).hexdigest() in text
    assert "each sensor missing in turn" in text
    assert found.rows[0].design == "both"
    limit = found.limit.rms_nm
    assert found.rows[0].residual_nm < limit  # of the own sensor alone
    assert f"alone leaves less than {limit:.1f}" in text


def test_the_command_takes_them_alone(sensors_file, gains, tmp_path, capsys):
    config, page = write_config(tmp_path), tmp_path / "page.html"
    status, text, _ = run(capsys, "report", config, sensors_file, "-o", page)
    assert (status, page.exists()) == (0, True)
    assert "above the limit" in text
    page.unlink()
    status, _, error = run(capsys, "report", config, sensors_file, gains["kalman"], "-o", page)
    assert (status, page.exists()) == (2, False)
    assert "lbt-synth limits takes both" in error


@pytest.fixture
def gains(tmp_path_factory, config):
    design = lbt.integrator(config.hardware, gain=0.5)
    return {"kalman": lbt.save_gain(tmp_path_factory.mktemp("own") / "own.fits", design)}
