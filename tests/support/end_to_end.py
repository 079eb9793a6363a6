"""End-to-end runs that need no SPECULA."""

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.specula.simulation import EndToEndRun

CONFIG = "examples/lbt.yaml"


def load_setup():
    return lbt.load_config(CONFIG).end_to_end


def make_run(setup, *, frames=4000):
    """A run that measures half the residual of the frame before, and 10 nm of noise."""
    rng = np.random.default_rng(0)
    residual = 50 * rng.standard_normal((frames, setup.modes))
    measured = 0.5 * np.roll(residual, 1, axis=0) + 10 * rng.standard_normal(residual.shape)
    return EndToEndRun(
        setup=replace(setup, frames=frames, seed=0),
        strehl_series=0.8 + 0.01 * rng.standard_normal(frames),
        other_modes_series=np.full(frames, 0.85),
        measurements=measured,
        commands=np.zeros_like(residual),
        residual_nm=residual,
        psf=np.ones((4, 4)) / 16,
        psf_pixel_mas=20.0,
    )
