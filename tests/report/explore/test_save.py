"""What the page saves: a configuration, a gain file, and the commands that make them."""

import numpy as np
import pytest
from support.commands import run

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import explore, quick_view
from lbt_synth.report.explore.save import save_view
from lbt_synth.report.explore.wish import Wish


@pytest.fixture(scope="module")
def exploration():
    return explore(lbt.load_config("examples/lbt.yaml"), {})


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_the_commands_make_the_files(exploration, tmp_path, monkeypatch, capsys, method):
    wish = Wish(method=method, values={"delay": 2.5, "shift": 0.7, f"{method}-gamma_ratio": 1.4})
    view = quick_view(exploration, wish)
    saved = save_view(exploration, view, tmp_path)
    config, gain, script = saved.files
    assert lbt.load_config(config).text == view.config.text
    kept = lbt.load_gain(gain)
    np.testing.assert_array_equal(kept.gain_predictor, view.design.gain_predictor)
    gain.unlink()
    monkeypatch.chdir(tmp_path)
    words = saved.commands[0].split()
    assert words[0] == "lbt-synth"
    assert saved.commands[0] in script.read_text().splitlines()
    status, _, error = run(capsys, *words[1:])
    assert (status, error) == (0, "")
    made = lbt.load_gain(gain)
    np.testing.assert_allclose(made.gain_predictor, kept.gain_predictor, rtol=1e-9, atol=1e-12)


def test_nothing_is_overwritten(exploration, tmp_path):
    view = quick_view(exploration, Wish(method="kalman"))
    first = save_view(exploration, view, tmp_path)
    (tmp_path / "explored-2.sh").write_text("mine")
    third = save_view(exploration, view, tmp_path)
    assert [path.name for path in first.files] == [
        f"explored-1.{e}" for e in ("yaml", "fits", "sh")
    ]
    assert [path.name for path in third.files] == [
        f"explored-3.{e}" for e in ("yaml", "fits", "sh")
    ]
    assert (tmp_path / "explored-2.sh").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 7


def test_the_head_says_what_was_moved(exploration, tmp_path):
    view = quick_view(exploration, Wish(method="kalman", values={"gain": 0.5}))
    config = save_view(exploration, view, tmp_path).files[0]
    head = config.read_text().splitlines()[:2]
    assert head[0].startswith("# 'lbt.yaml' with real sensor gain 0.5; lbt_synth ")
    assert head[1] == "# lbt-synth design explored-1.yaml --method kalman -o explored-1.fits"


def test_a_folder_that_takes_nothing_is_said(exploration, tmp_path):
    view = quick_view(exploration, Wish(method="kalman"))
    with pytest.raises(lbt.errors.OutputError, match="cannot write"):
        save_view(exploration, view, tmp_path / "nowhere")
