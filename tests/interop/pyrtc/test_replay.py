"""pyRTC's predictors: what they say without it, and what they predict with it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.interop import pyrtc_commands
from lbt_synth.interop.pyrtc import replay as pyrtc

WHITE = np.random.default_rng(0).standard_normal((3000, 2))
SLOW = lfilter([1], [1, -0.9], WHITE, axis=0)


def test_without_it_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(pyrtc, "pyrtc_version", lambda: None)
    with pytest.raises(MissingExtraError, match=r"pip install \"lbt-synth\[pyrtc\]\"") as caught:
        pyrtc_commands("ar_kalman", SLOW, SLOW)
    assert caught.value.extra == "pyrtc"


def test_a_distribution_that_is_not_there_has_no_version(monkeypatch):
    monkeypatch.setattr(pyrtc, "_DISTRIBUTION", "no-such-distribution-of-lbt-synth")
    assert pyrtc.pyrtc_version() is None
    monkeypatch.setattr(pyrtc, "_DISTRIBUTION", "numpy")
    assert pyrtc.pyrtc_version() == np.__version__


@pytest.mark.e2e
def test_an_ar1_process_is_predicted_by_the_square_of_its_pole():
    pytest.importorskip("pyrtc")
    now = SLOW[2000:]
    assert np.array_equal(pyrtc_commands("persistence", SLOW[:2000], now), now)
    taught = pyrtc_commands("least_squares", SLOW[:2000], now, horizon=2)
    assert np.mean((taught - 0.81 * now)[50:] ** 2) < 0.02 * np.mean(now**2)
    ahead = np.mean((now[52:] - taught[50:-2]) ** 2) / (1 + 0.9**2)
    assert 0.9 < ahead < 1.1
    # the past alone
    other = np.vstack([now[:500], 9 * now[500:]])
    again = pyrtc_commands("least_squares", SLOW[:2000], other, horizon=2)
    assert np.array_equal(again[:500], taught[:500])


@pytest.mark.e2e
@pytest.mark.parametrize("kind", ["ar_kalman", "magic"])
def test_what_pyrtc_refuses_is_an_error_of_ours(kind):
    pytest.importorskip("pyrtc")
    with pytest.raises(ProblemError, match=f"pyRTC's predictor {kind} failed"):
        pyrtc_commands(kind, SLOW[:20], SLOW)
