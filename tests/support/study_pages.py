"""A study with all that can go wrong in one, and its page."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.report.pages import study_page
from lbt_synth.studies.study.statistics import study_statistics

PARAMETERS = ("truth.sensor_gain", "error.delay_frames", "atmosphere.wind_speed_m_s", "fixed")


def results(n=300, seed=0):
    """Three controllers: one steady, one that low gains make unstable, one that fails at times."""
    rng = np.random.default_rng(seed)
    gain, delay = 0.4 + 0.7 * rng.random(n), 0.3 * rng.random(n)
    wind = rng.choice([10.0, 20.0, 30.0], n)
    strehls = {
        "steady": 0.8 - 0.1 * delay - 0.002 * wind,
        "sharp": 0.9 * gain / 1.1 - 0.5 * delay,
        "frail": 0.7 - 0.2 * gain,
    }
    stable = {name: np.ones(n) for name in strehls}
    stable["sharp"][gain < 0.5] = 0
    stable["frail"][::50] = np.nan
    columns = {
        "row": np.arange(n),
        "truth.sensor_gain": gain,
        "error.delay_frames": delay,
        "atmosphere.wind_speed_m_s": wind,
        "fixed": np.full(n, 0.9),
    }
    for name, strehl in strehls.items():
        there = stable[name] == 1
        columns[f"{name}.stable"] = stable[name]
        columns[f"{name}.strehl"] = np.where(there, strehl, np.nan)
        columns[f"{name}.residual_nm"] = np.where(there, 100 * (1 - strehl), np.nan)
    return columns


CONTROLLERS = ("steady", "sharp", "frail")
FAILURES = [(row, "frail", f"<b>no</b> design in row {row}") for row in range(0, 300, 20)]


@cache
def night():
    """A study of 300 samples, read from night.yaml."""
    study = lbt.studies.load_study(ROOT / "examples" / "study.yaml")
    settings = study.settings.model_copy(update={"samples": 300})
    return replace(study, settings=settings, source=Path("night.yaml"))


def page_of(columns, controllers=CONTROLLERS, parameters=PARAMETERS, study=None):
    columns = {"row": np.arange(len(columns[f"{controllers[0]}.stable"]))} | columns
    statistics = study_statistics(columns, parameters, controllers)
    more = {"folder": "out", "failures": FAILURES, "computing_s": 75.0}
    return study_page(study or night(), columns, statistics, **more)
