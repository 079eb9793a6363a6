"""Channels that do harm on the record, though their model says that they help."""

import numpy as np
import pytest
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.accelerometers.replayed_channels import drop_harmful

RATE, FRAMES = 1000.0, 20_000
LINE = lbt.Vibration(frequency_hz=31, damping=0.01, rms_nm=60)


@pytest.fixture(scope="module")
def night():
    """An open loop with one line and noise, its model, and a channel that follows twofold."""
    rng, line = np.random.default_rng(4), LINE.ar_model(RATE)
    drive = line.driving_rms_nm * rng.standard_normal(FRAMES + 2002)
    v = lfilter([1], [1, *-line.coefficients], drive)[2000:]
    seen = v[1:-1] + 30 * rng.standard_normal(FRAMES)
    record = lbt.identification.loop_record(
        seen[:, None], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    channel = 2e-9 * RATE**2 * np.diff(v, 2) + 1e-3 * rng.standard_normal(FRAMES)
    return record, lbt.identify(record), channel


def judge(night, *channels):
    record, model, _ = night
    given = np.column_stack(channels)
    found = lbt.identification.accelerometer_transfers(model, record, given)
    assert len(found.used) == len(channels)
    return drop_harmful(found, model, record, given)


def test_channels_that_help_stay(night):
    found = judge(night, night[2])
    assert [row.verdict for row in found.used] == ["used for 31 Hz"]


def test_hum_that_the_filter_would_follow_leaves_its_channel_out(night):
    time_s = np.arange(FRAMES) / RATE
    hum = night[2] + 20 * night[2].std() * np.sin(2 * np.pi * 50 * time_s)
    found = judge(night, hum, night[2])
    assert [row.channel for row in found.used] == ["channel2"]
    assert found.channels[0].verdict.startswith("left out, because the filter leaves more")
    assert found.channels[0].verdict.endswith("shows 31 Hz")
    assert not any(row.useful for row in found.transfers if row.channel == "channel1")


def test_weak_hum_makes_the_channel_noisier(night):
    time_s = np.arange(FRAMES) / RATE
    hum = night[2] + 2 * night[2].std() * np.sin(2 * np.pi * 50 * time_s)
    quiet, found = judge(night, night[2]), judge(night, hum)
    assert [row.verdict for row in found.used] == ["used for 31 Hz"]
    assert found.used[0].noise_m_s2 > 2 * quiet.used[0].noise_m_s2


def test_an_offset_is_taken_away(night):
    assert len(judge(night, night[2] + 9.81).used) == 1
