"""The section of the mirror in a configuration."""

from __future__ import annotations

import pytest
from support.plants import ROOT

import lbt_synth as lbt

SLOW_YAML = ROOT / "examples" / "lbt_slow_mirror.yaml"


# Configuration and command line
def test_the_example_has_a_mirror_for_design_and_loop():
    config = lbt.load_config(SLOW_YAML)
    assert config.hardware.mirror is config.plant.hardware.mirror
    step = config.hardware.mirror.step_response()
    assert 3e-3 < step.settling_s < 6e-3
    rows = lbt.studies.mirror(config.plant, config.truth, config.imaging)
    by_name = {row.design: row for row in rows}
    assert not by_name["kalman, settled mirror"].stable
    assert by_name["lqg"].strehl > 0.8
    assert by_name["lqg"].residual_nm < 0.3 * by_name["kalman, real positions"].residual_nm


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bandwidth_hz: 100.0", "bandwith_hz: 100.0", "did you mean bandwidth_hz"),
        ("bandwidth_hz: 100.0", "proportional_per_s2: 4.0e5", "expected either bandwidth_hz"),
        (
            "    bandwidth_hz: 100.0",
            "    proportional_per_s2: 4.0e5\n    derivative_per_s: 800.0",
            "bandwidth_damping goes with bandwidth_hz",
        ),
        ("bandwidth_hz: 100.0", "bandwidth_hz: 10.0", "mirror.local_loop: bandwidth_hz must be"),
        ("frame_rate_hz: 800.0", "frame_rate_hz: 990.0", "986.30137 and 1000 Hz"),
        ("delay_samples: 1", "delay_samples: 1.5", "mirror.local_loop.delay_samples"),
    ],
)
def test_wrong_sections_are_refused(tmp_path, old, new, message):
    text = SLOW_YAML.read_text()
    assert old in text
    path = tmp_path / "a.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(lbt.errors.ConfigError, match=message):
        lbt.load_config(path)


def test_gains_of_a_configuration(tmp_path):
    text = SLOW_YAML.read_text()
    start = text.index("    bandwidth_hz: 100.0")
    end = text.index("    sampling_hz")
    path = tmp_path / "a.yaml"
    path.write_text(
        text[:start] + "    proportional_per_s2: 4.0e5\n    derivative_per_s: 800.0\n" + text[end:]
    )
    mirror = lbt.load_config(path).hardware.mirror
    assert (mirror.proportional_per_s2, mirror.derivative_per_s) == (4.0e5, 800.0)
