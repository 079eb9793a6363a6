"""Robust controllers beside the filters, in the truth and with the lines anywhere in their bands.

    python benchmarks/robust_bands.py

A telescope of 8 m with a resonance on each axis, with and without their damping in the bands, and
one of 39 m whose wind shake at 0.3 Hz lies in no band.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from ruamel.yaml import YAML

import lbt_synth as lbt
from lbt_synth.studies.limits import compare_in_truth

SHIFTS = np.linspace(-1, 1, 17)  # of a line within its band, in units of the half width


def settings(diameter_m: float, wind: float, lines: list[dict], *, bands: list[dict]) -> dict:
    """Return a configuration: frozen flow, resonances in model and truth, bands around some."""
    return {
        "version": 1,
        "telescope": {"diameter_m": diameter_m},
        "atmosphere": {
            "seeing_arcsec": 0.8,
            "seeing_wavelength_um": 0.5,
            "outer_scale_m": 25.0,
            "wind_speed_m_s": wind,
        },
        "sensor": {"noise_nm": 20.0},
        "loop": {"frame_rate_hz": 1000.0, "delay_frames": 2.0},
        "model": {"turbulence": {"kind": "ar2"}, "vibrations": lines},
        "truth": {"vibrations": [{"kind": "resonance", **line} for line in lines]},
        "design": {"robust": {"bands": bands}},
    }


def line(axis: str, frequency_hz: float, damping: float, rms_mas: float) -> dict:
    """Return a vibration."""
    return {"axis": axis, "frequency_hz": frequency_hz, "damping": damping, "rms_mas": rms_mas}


def band(axis: str, low_hz: float, high_hz: float, rms_mas: float, **more: float) -> dict:
    """Return a band."""
    return {"axis": axis, "low_hz": low_hz, "high_hz": high_hz, "rms_mas": rms_mas, **more}


VLT = [line("tip", 18.0, 0.01, 12.0), line("tilt", 48.0, 0.01, 8.0)]
VLT_BANDS = [band("tip", 16.0, 20.0, 12.0), band("tilt", 45.0, 51.0, 8.0)]
ELT = [
    line("both", 0.3, 0.3, 100.0),
    line("tip", 18.0, 0.005, 3.0),
    line("tilt", 32.0, 0.005, 2.0),
]
ELT_BANDS = [band("tip", 16.0, 20.0, 3.0), band("tilt", 29.0, 35.0, 2.0)]
CASES = {
    "8 m, damping of the model": settings(8.0, 12.0, VLT, bands=VLT_BANDS),
    "8 m, bands for sinusoids": settings(
        8.0, 12.0, VLT, bands=[{**each, "damping": 0.0} for each in VLT_BANDS]
    ),
    "39 m, wind shake in no band": settings(39.0, 10.0, ELT, bands=ELT_BANDS),
}


def worst_nm(config: lbt.config.Config, design: lbt.Design) -> float:
    """Return the residual with each line of a band at its worst place in it."""
    loop = lbt.close_loop(config.hardware, design.controller)
    bands = config.method_section("robust").bands
    total = (
        lbt.residual_budget(loop, replace(config.truth, vibrations=()), frame_means=True).rms_nm
        ** 2
    )
    for shaken in config.truth.vibrations:
        own = next((b for b in bands if b.low_hz <= shaken.frequency_hz <= b.high_hz), None)
        places = [shaken.frequency_hz]
        if own is not None:
            half = (own.high_hz - own.low_hz) / 2
            places = list((own.high_hz + own.low_hz) / 2 + half * SHIFTS)
        alone = lbt.Truth(turbulence=None)
        total += max(
            lbt.residual_budget(
                loop,
                replace(alone, vibrations=(replace(shaken, frequency_hz=float(f)),)),
                frame_means=True,
            ).rms_nm
            ** 2
            for f in places
        )
    return float(np.sqrt(total))


def main() -> None:
    """Print a table of each case."""
    with TemporaryDirectory() as folder:
        for title, content in CASES.items():
            path = Path(folder) / "case.yaml"
            with path.open("w") as stream:
                YAML(typ="safe", pure=True).dump(content, stream)
            config = lbt.load_config(path)
            robust = config.design("robust")
            found = compare_in_truth({"robust": robust}, config)
            designs = {"robust": robust} | {
                name: config.design(name) for name in ("integrator", "kalman", "hinf")
            }
            print(f"\n{title}: limit {found.limit.rms_nm:.2f} nm")
            for row in found.rows:
                worst = worst_nm(config, designs[row.design])
                print(f"  {row.design:12s} {row.residual_nm:8.2f} nm, worst {worst:8.2f} nm")
            for text in found.warnings["robust"]:
                print(f"  {text}")


if __name__ == "__main__":
    main()
