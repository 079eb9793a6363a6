"""Random matrices with uncertainties of random structure."""

import numpy as np

from lbt_synth.linear import Block


def random_case(seed, kinds):
    """Return a complex matrix, 2 to 5 blocks of these kinds, and the blocks as SLICOT takes them.

    Full blocks have up to 3 rows and columns, the others are single numbers.
    """
    rng = np.random.default_rng(seed)
    drawn = [str(rng.choice(kinds)) for _ in range(rng.integers(2, 6))]
    sizes = [int(rng.integers(1, 4)) if kind == "full" else 1 for kind in drawn]
    blocks = [Block(size=size, kind=kind) for size, kind in zip(sizes, drawn, strict=True)]
    n = sum(sizes)
    matrix = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    types = [1 if kind == "real" else 2 for kind in drawn]
    return matrix * 10 ** rng.normal(size=(n, 1)), blocks, (np.array(sizes), np.array(types))


def random_uncertainty(rng, blocks):
    """Return a random uncertainty of these blocks, each of norm one."""
    rows, columns = np.sum([each.shape for each in blocks], axis=0)
    delta = np.zeros((rows, columns), dtype=complex)
    r = c = 0
    for block in blocks:
        p, q = block.shape
        if block.kind == "full":
            own = rng.normal(size=(p, q)) + 1j * rng.normal(size=(p, q))
            own = own / np.linalg.norm(own, 2)
        elif block.kind == "complex":
            own = np.exp(2j * np.pi * rng.random()) * np.eye(p)
        else:
            own = rng.choice([-1.0, 1.0]) * np.eye(p)
        delta[r : r + p, c : c + q] = own
        r, c = r + p, c + q
    return delta
