"""Bands of three lines whose skirts reach into each other's band."""

import numpy as np

from lbt_synth.identification.accelerometers.line_bands import LineBand

FACTORS = np.array([3.0 - 1.0j, -0.4 + 0.2j, 0.7j])


def make_bands(factors=FACTORS, noise=0.0):
    """Return a band per line; every line shows in every band, the strong first one most."""
    rng = np.random.default_rng(4)
    out = []
    for j in range(3):
        parts = rng.standard_normal((2, 60, 3)) * [3.0, 0.3, 0.3]
        expected = parts[0] + 1j * parts[1]
        expected[:, j] *= 2
        drawn = noise * (rng.standard_normal((60, 1)) + 1j * rng.standard_normal((60, 1)))
        band = LineBand(
            lines=(j,),
            angle=np.linspace(0.1, 0.2, 60) + j,
            readings=expected @ factors[:, None] + drawn,
            expected=expected,
            moved=0.01 * (expected * (np.arange(3) == j))[:, :, None],
            unseen=np.zeros((60, 3, 3)),
            core=np.ones((60, 1), dtype=bool),
        )
        out.append(band)
    return out
