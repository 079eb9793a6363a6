"""Configurations that are written, and read again."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.identified_models import ONE_AXIS
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.config.schema import FileSection
from lbt_synth.config.write import config_text


@pytest.mark.parametrize("name", ["lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"])
def test_the_examples_are_written_as_they_are(tmp_path, name):
    before = lbt.load_config(ROOT / "examples" / name)
    after = lbt.load_config(lbt.config.save_config(tmp_path / name, before.settings))
    assert after.settings == before.settings
    assert after.settings.model_fields_set == before.settings.model_fields_set
    np.testing.assert_array_equal(after.plant.A, before.plant.A)
    assert after.truth.vibrations == before.truth.vibrations


positive = st.floats(0.1, 100.0)


finite = st.floats(-1e4, 1e4)


@given(
    noise=positive | st.lists(positive, min_size=1, max_size=3),
    a=st.lists(finite, min_size=1, max_size=5),
    angle=finite,
    frequency=positive,
    frames=st.integers(2, 10**9),
    scale=st.none() | positive,
    many=st.booleans(),
)
def test_whatever_is_set_is_read_again(noise, a, angle, frequency, frames, scale, many):
    ar_section = {"kind": "ar", "coefficients": a, "driving_rms_nm": frequency}
    settings = FileSection.model_validate(
        {
            "version": 1,
            "atmosphere": {
                "seeing_arcsec": frequency,
                "outer_scale_m": scale,
                "wind_speed_m_s": frequency,
            },
            "sensor": {"noise_nm": noise, "matrix": [a, a]},
            "loop": {"frame_rate_hz": frequency},
            "model": {
                "turbulence": [ar_section, {"kind": "ar1"}] if many else ar_section,
                "vibrations": [
                    {
                        "direction_deg": angle,
                        "frequency_hz": frequency,
                        "damping": 0.1,
                        "rms_nm": frequency,
                    },
                ],
            },
            "truth": {"vibrations": "model"} if many else {"vibrations": []},
            "simulation": {"frames": frames},
        }
    )
    text = config_text(settings, {"loop.frame_rate_hz": "a # comment: [odd] ' \" é"})
    assert "odd" in text  # config_text reads it again, and refuses what has changed


@pytest.mark.parametrize(
    ("comments", "text"),
    [
        ({"loop.frame_rate_khz": "?"}, "one on loop.frame_rate_khz"),
        ({"loop.delay_frames": "a\nb"}, "must be one line"),
        ({"loop.frame_rate_hz": "\x00"}, "cannot be written so that it is read again"),
    ],
)
def test_comments_that_have_no_place(tmp_path, comments, text):
    settings, _ = lbt.config.identified_config(ONE_AXIS)
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.config.save_config(tmp_path / "a.yaml", settings, comments=comments)
    assert not list(tmp_path.iterdir())


def test_only_configurations_are_written(tmp_path):
    with pytest.raises(lbt.errors.ProblemError, match="FileSection"):
        lbt.config.save_config(tmp_path / "a.yaml", {"version": 1})
    settings, _ = lbt.config.identified_config(ONE_AXIS)
    with pytest.raises(lbt.errors.OutputError, match="cannot write"):
        lbt.config.save_config(tmp_path / "none" / "a.yaml", settings)
