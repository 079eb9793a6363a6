"""Configurations that do not describe an end-to-end simulation."""

from pathlib import Path

import pytest
from support.end_to_end import CONFIG

import lbt_synth as lbt
from lbt_synth.errors import ConfigError


def test_a_sensor_matrix_cannot_be_simulated(tmp_path):
    text = Path(CONFIG).read_text().replace("sensor:\n", "sensor:\n  matrix: [[1, 0], [0, 2]]\n", 1)
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"sensor\.matrix must be left out"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end


def test_without_a_pyramid(tmp_path):
    text = Path(CONFIG).read_text()
    start, end = text.index("  pyramid:"), text.index("mirror:")
    (tmp_path / "c.yaml").write_text(text[:start] + "  noise_nm: 15.0\n\n" + text[end:])
    with pytest.raises(ConfigError, match=r"sensor\.pyramid is missing"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end
