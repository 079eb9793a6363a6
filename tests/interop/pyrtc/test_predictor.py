"""The predictor that pyRTC runs, without pyRTC."""

import numpy as np
import pytest
from support.exports import lbt_designs
from support.gain_file_edits import odd_plant

import lbt_synth as lbt
from lbt_synth.interop.pyrtc.pol_filter import pol_filter
from lbt_synth.interop.pyrtc.predictor import GainFilePredictor

LAZY = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500, modes=1), gain=0.5)


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gains")
    for name in ("kalman", "integrator"):
        lbt.save_gain(folder / f"{name}.fits", lbt_designs()[name])
    lbt.save_gain(folder / "odd.fits", lbt.kalman(odd_plant()))
    lbt.save_gain(folder / "lazy.fits", LAZY)
    return folder


def run(predictor, series):
    out = []
    for pol in series:
        predictor.update(pol)
        out.append(predictor.predict())
    return np.array(out)


def test_it_predicts_as_the_filter_after_the_frames_of_the_delay(gains):
    series = np.random.default_rng(0).standard_normal((200, 2)).astype(np.float32)
    predictor = GainFilePredictor(2, gain_file=gains / "kalman.fits")
    for _ in range(2):  # reset brings back the start
        running = pol_filter(lbt_designs()["kalman"]).start()
        own = np.array([running.step(pol.astype(float)) for pol in series])
        found = run(predictor, series)
        assert np.array_equal(found[2:], own[2:])
        assert not np.any(found[:2])
        predictor.reset()


def test_a_value_that_is_not_finite_repeats_the_last_command(gains):
    series = np.random.default_rng(0).standard_normal((50, 2))
    spoilt = np.insert(series, 20, [np.nan, 1.0], axis=0)
    clean, other = (
        run(GainFilePredictor(2, gain_file=gains / "kalman.fits"), s) for s in (series, spoilt)
    )
    assert np.array_equal(other[20], clean[19])
    assert np.array_equal(np.delete(other, 20, axis=0), clean)


def test_further_modes_have_an_integrator_and_all_are_clipped(gains):
    predictor = GainFilePredictor(2, gain_file=gains / "lazy.fits", other_gain=0.25)
    # the residual is what pyRTC adds less: 1, 1, 1 - 0.25, 1 - 0.5
    assert run(predictor, np.ones((6, 2)))[:, 1].tolist() == [0, 0, 0.25, 0.5, 0.6875, 0.8125]
    held = GainFilePredictor(2, gain_file=gains / "lazy.fits", command_limit=0.75)
    assert run(held, np.ones((4, 2))).tolist() == [[0, 0], [0, 0], [0.75, 0], [0.75, 0]]


def test_what_does_not_fit_is_refused(gains):
    slow, lazy = (
        {"gain_file": gains / "integrator.fits"},
        GainFilePredictor(1, gain_file=gains / "lazy.fits"),
    )
    odd = GainFilePredictor(2, 3, gain_file=gains / "odd.fits")
    short = np.random.default_rng(0).standard_normal((400, 1))
    for call, words in (
        (lambda: GainFilePredictor(2, 3, **slow), "predictor.delay_frames must be 2, that of"),
        (lambda: GainFilePredictor(1, **slow), "must control at least the 2 modes of"),
        (
            lambda: GainFilePredictor(2, other_gain=-0.5, **slow),
            "predictor.other_gain must be at least 0",
        ),
        (
            lambda: GainFilePredictor(2, command_limit=0, **slow),
            "predictor.command_limit must be above 0",
        ),
        (lambda: odd.fit(np.zeros((10_000, 2))), "whole frames; that of"),
        (lambda: lazy.fit(short), "needs 4096 usable frames"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            call()
    assert not lazy.fitted
    with pytest.raises(lbt.errors.CertificateError, match="closed loop"):
        GainFilePredictor(3, other_gain=1.5, **slow)


def test_further_modes_run_the_integrator_of_other_targets(gains):
    """In a loop of the same delay: the commands of a design of all modes."""
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    whole = lbt.integrator(path, gain=0.4).controller.start()
    predictor = GainFilePredictor(2, gain_file=gains / "lazy.fits", other_gain=0.4)
    phase = np.cumsum(np.random.default_rng(0).standard_normal(300))
    phase[:2] = 0.0
    ours, theirs = [0.0, 0.0], [0.0, 0.0]  # u(k-1) corrects what frame k + 1 measures
    for value in phase:
        ours.append(float(whole.step([value - ours[-2]])[0]))
        pol = value - theirs[-2] + theirs[-2]
        predictor.update([0.0, pol])
        theirs.append(float(np.float32(predictor.predict()[1])))
    assert np.allclose(theirs, ours, rtol=1e-5, atol=1e-5)
    assert np.max(np.abs(ours)) > 5


def test_a_damaged_gain_file_is_one_sentence(gains, tmp_path):
    content = bytearray((gains / "kalman.fits").read_bytes())
    content[content.index(lbt_designs()["kalman"].gain_predictor.astype(">f8").tobytes())] ^= 1
    (tmp_path / "bad.fits").write_bytes(content)
    with pytest.raises(
        lbt.errors.GainFileError, match=r"bad.fits is no gain file, or it is damaged"
    ) as caught:
        GainFilePredictor(2, gain_file=tmp_path / "bad.fits")
    assert "\n" not in str(caught.value)


def test_fit_identifies_the_series_and_designs_for_it(gains):
    """In any unit, and with frames that are not finite."""
    rng = np.random.default_rng(0)
    turns = 2 * np.pi * 31.0 / 500 * np.arange(4400)
    series = 100 * np.sin(turns)[:, None] + 5 * rng.standard_normal((4400, 1))
    series = 1e6 * (series + np.cumsum(rng.standard_normal((4400, 1)), axis=0))
    predictor = GainFilePredictor(1, gain_file=gains / "lazy.fits")
    before = run(predictor, series)
    spoilt = series.copy()
    spoilt[100] = np.nan
    assert predictor.fit(spoilt) is predictor
    assert predictor.fitted
    after = run(predictor, series)
    left, gone = (np.std((series[2:] - found[:-2])[2000:]) for found in (before, after))
    assert gone < 0.3 * left
