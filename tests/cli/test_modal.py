"""The command modal."""

import csv
import json

import numpy as np
import pytest
from support.commands import run
from support.plants import LBT_YAML

import lbt_synth as lbt


def test_modal(tmp_path, capsys):
    table, figure = tmp_path / "m.csv", tmp_path / "m.png"
    status, text, error = run(
        capsys, "modal", LBT_YAML, "--modes", 60, "-o", table, "-o", figure, "--verbose"
    )
    assert (status, error) == (0, "")
    for words in ("By radial order", "optimised gains", "Kalman filters", "assumed", "written"):
        assert words in text
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [int(row["modes"]) for row in rows] == [2, 3, 4, 5, 6, 7, 8, 9, 10, 6]
    assert sum(int(row["modes"]) for row in rows) == 60


def test_modal_without_a_pyramid(tmp_path, capsys):
    text = LBT_YAML.read_text()
    start, end = text.index("  pyramid:"), text.index("mirror:")
    config = tmp_path / "c.yaml"
    plain = text[:start] + "  noise_nm: 12.0\n\n" + text[end:]
    config.write_text(plain)
    status, out, _ = run(capsys, "modal", config, "--modes", 5, "--verbose")
    assert status == 0
    assert "12 nm on every mode" in out
    config.write_text(plain.replace("mirror:\n  modes: 672                        # (I)\n", ""))
    status, _, error = run(capsys, "modal", config)
    assert status == 2
    assert "the key mirror.modes is missing" in error


def test_modal_knows_the_local_loop(capsys):
    """Gains and filters of a slow mirror are those of loops with that mirror."""
    slow = LBT_YAML.parent / "lbt_slow_mirror.yaml"
    status, text, _ = run(capsys, "modal", slow, "--modes", 5, "--json")
    assert status == 0
    data, config = json.loads(text), lbt.load_config(slow)
    shell = config.hardware.mirror
    assert shell is not None
    air = lbt.models.modal_turbulence(config.atmosphere, modes=5, frame_rate_hz=800)
    noise = lbt.models.pyramid_modal_noise_nm(config.noise_nm, modes=5, modulation_lambda_over_d=4)
    line = config.plant.vibrations[0]
    known = {"noise_nm": noise, "vibrations": {0: line, 1: line}}
    gains = lbt.design.modal.modal_gains(air, frame_rate_hz=800, mirror=shell, **known)
    filters = lbt.design.modal.modal_filters(air, mirror=shell, **known)
    assert data["rows"][0]["gain"] == pytest.approx(gains.gains[0])
    assert data["residual_nm"]["Kalman filters"] == pytest.approx((filters.rms_nm**2).sum() ** 0.5)
    control = lbt.design.modal.MixedController(gains=gains.gains)
    left = lbt.design.modal.modal_residuals(control, air, hardware=gains.hardware, **known)
    assert np.allclose(left, gains.rms_nm, rtol=1e-6)
    status, text, _ = run(capsys, "modal", slow, "--modes", 5, "--verbose")
    assert "the Kalman filters know its real positions" in text
