"""End-to-end runs that need no SPECULA."""

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.specula.simulation import EndToEndRun

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
