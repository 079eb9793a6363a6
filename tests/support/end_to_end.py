"""End-to-end runs and tables that need no SPECULA."""

from dataclasses import replace
from functools import cache

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.specula.simulation import EndToEndRun
from lbt_synth.studies.paper import all_cases, make_entries, plan_cases

CONFIG = "examples/lbt.yaml"


def load_setup():
    return lbt.load_config(CONFIG).end_to_end


def make_run(setup, *, gain=0.5, noise_nm=10.0, frames=4000, seed=0):
    """A run whose measurements are a gain times the residual of the frame before, and noise."""
    rng = np.random.default_rng(seed)
    residual = 50 * rng.standard_normal((frames, setup.modes))
    measured = np.zeros_like(residual)
    measured[1:] = gain * residual[:-1]
    measured += noise_nm * rng.standard_normal(measured.shape)
    return EndToEndRun(
        setup=replace(setup, frames=frames, seed=seed),
        strehl_series=0.8 + 0.01 * rng.standard_normal(frames),
        other_modes_series=np.full(frames, 0.85),
        measurements=measured,
        commands=np.zeros_like(residual),
        residual_nm=residual,
        psf=np.ones((4, 4)) / 16,
        psf_pixel_mas=20.0,
    )


def fake_results(rows, gain=0.6, strehl=0.7):
    return {
        name: {
            "strehl": strehl + 0.01 * case["setup"].seed,
            "other_modes_strehl": 0.85,
            "tip_rms_nm": 30.0,
            "tilt_rms_nm": 40.0,
            "tip_tilt_gain": gain,
        }
        for name, case in all_cases(rows).items()
    }


@cache
def plan_rows():
    fixed = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    return plan_cases(load_setup(), {"slow": fixed}, seeds=(0, 1), row_seeds=(0,))


@cache
def make_table():
    some = [pair for pair in plan_rows() if pair[0].error_hz in (None, -3.5, 0.0, 3.5)]
    return make_entries(some, fake_results(some), load_setup())
