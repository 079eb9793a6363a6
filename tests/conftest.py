"""Plants that many tests share."""

import gc
import re
from dataclasses import replace

import hypothesis
import matplotlib as mpl
import pytest
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt

mpl.use("Agg")
hypothesis.settings.register_profile("default", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("default")


def pytest_collection_finish():
    """Leave the thousands of collected tests out of every later garbage collection."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_addoption(parser):
    parser.addoption("--no-skips", action="store_true", help="a check that was not made is no pass")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    if session.config.getoption("--no-skips") and skipped:
        reporter.write_line(f"\nfailed: {len(skipped)} skipped under --no-skips", red=True)
        session.exitstatus = exitstatus or pytest.ExitCode.TESTS_FAILED


@pytest.fixture
def axis_plant():
    return lbt_axis_plant()


@pytest.fixture
def air():
    return lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)


@pytest.fixture(scope="session")
def config():
    return lbt.load_config(LBT_YAML)


@pytest.fixture(scope="session")
def lbt_designs(config):
    """Three designs for that configuration."""
    return {
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
        "integrator": lbt.integrator(config.hardware, gain=0.5),
    }


@pytest.fixture(scope="session")
def small_config(tmp_path_factory):
    """The same loop with few errors, frames and cases."""
    few = "errors_hz: [-3.5, 3.5]\n  sensor_gains: [0.3, 0.5, 1.0, 1.3]"
    text = re.sub("errors_hz: .*", few, LBT_YAML.read_text())
    file = tmp_path_factory.mktemp("small") / "small.yaml"
    file.write_text(text.replace("frames: 8000", "frames: 1000").replace("cases: 4", "cases: 2"))
    return lbt.load_config(file)


@pytest.fixture(scope="session")
def small_designs(small_config):
    """A Kalman filter, an integrator, and one whose loop is unstable, by name."""
    slow = lbt.integrator(small_config.hardware, gain=0.4)
    wild = replace(slow, claims={"gain": 1.5})  # unstable at gains above 2/3
    return {"kalman": lbt.kalman(small_config.plant), "slow": slow, "wild": wild}


@pytest.fixture(scope="module")
def cluster():
    """Two Dask workers of one thread each, on this machine."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(processes=True, **options) as made:
        yield made


SENSORS = """\
version: 1
telescope: {diameter_m: 8.22, obstruction: 0.11}
loop: {frame_rate_hz: 1000, delay_frames: 2, axes: 2}
sensor: {noise_nm: 75}
sensors:
  slow: {rate_hz: 500, delay_frames: 2.5, noise_nm: 20}
  mirror:
    {kind: accelerometer, rate_hz: 1000, delay_frames: 1, channels: [m1, m2], noise_m_s2: 2.0e-4}
model:
  turbulence: {kind: ar, coefficients: [0.999], driving_rms_nm: 8}
  vibrations:
    - {axis: tip, frequency_hz: 20, damping: 0.01, rms_nm: 500,
       accelerometers: {m1: {motion_nm_per_nm: 2}}}
    - {axis: tilt, frequency_hz: 33, damping: 0.01, rms_nm: 200,
       accelerometers: {m2: {motion_nm_per_nm: 1.5, phase_deg: 150}}}
truth: {vibrations: model}
robustness: {errors_hz: [2], sensor_gains: [0.5, 1]}
simulation: {frames: 2000, cases: 2, settle_frames: 500}
"""


@pytest.fixture(scope="session")
def sensors_config(tmp_path_factory):
    """A small loop: a dim star, a slow quiet sensor and two accelerometers."""
    path = tmp_path_factory.mktemp("sensors") / "sensors.yaml"
    path.write_text(SENSORS)
    return lbt.load_config(path)


@pytest.fixture(scope="session")
def sensors_design(sensors_config):
    return sensors_config.design("kalman")


@pytest.fixture(scope="session")
def sensors_file(sensors_design, tmp_path_factory):
    return lbt.save_gain(tmp_path_factory.mktemp("sensors_gain") / "sensors.fits", sensors_design)
