"""Small studies for the tests."""

from __future__ import annotations

import textwrap
from pathlib import Path

from support.plants import LBT_YAML

import lbt_synth as lbt

# cheap to evaluate: turbulence of the model, one integrator
BASE = """
    version: 1
    telescope: {diameter_m: 8.22, obstruction: 0.11}
    sensor: {noise_nm: 15.0}
    loop: {axes: 1, frame_rate_hz: 800.0}
    model:
      turbulence: {kind: ar, coefficients: [0.9886], driving_rms_nm: 89.1}
      vibrations: [{frequency_hz: 20.0, damping: 0.01, rms_nm: 500.0}]
    truth:
      vibrations: [{kind: sinusoid, frequency_hz: 20.0, rms_nm: 500.0}]
    simulation: {frames: 400, cases: 1, settle_frames: 100}
"""
STUDY = {
    "version": "1",
    "config": "base.yaml",
    "samples": "16",
    "seed": "3",
    "controllers": "{slow: {design: integrator, gain: 0.3}}",
    "parameters": "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}}",
}


def study_file(folder: Path, *, base: str = BASE, **changes: str) -> Path:
    """Write a study and its configuration; changes replace keys, None leaves one out."""
    (folder / "base.yaml").write_text(textwrap.dedent(base))
    lines = [f"{k}: {v}" for k, v in {**STUDY, **changes}.items() if v is not None]
    path = folder / "study.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def loaded(folder: Path, **changes: str) -> lbt.studies.Study:
    return lbt.studies.load_study(study_file(folder, **changes))


LBT_TEXT = LBT_YAML.read_text()
