"""Reconstructors, and modes made orthogonal to others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.interaction import interaction
from support.refusals import require_refusals

from lbt_synth.design.modal import project_out, reconstructor
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError


@settings(max_examples=15)
@given(q=st.integers(1, 12), n=st.integers(1, 12), seed=st.integers(0, 100))
def test_inverse_is_that_of_numpy(q, n, seed):
    D = interaction(q, n, seed)
    made = reconstructor(D, kept=min(q, n))
    assert np.allclose(made.matrix, np.linalg.pinv(D, rcond=1e-14), rtol=1e-6, atol=1e-9)
    if n <= q:
        assert np.allclose(made.matrix @ D, np.eye(n), atol=1e-7)


def test_truncation_leaves_out_the_weakest():
    left, _ = np.linalg.qr(interaction(6, 4))
    right, _ = np.linalg.qr(interaction(4, 4, 1))
    values = np.array([8.0, 4.0, 1.0, 0.01])
    D = left * values @ right.T
    full = reconstructor(D)
    assert full.condition_number == pytest.approx(800)
    spread = np.linalg.norm(right / values @ left.T, axis=1)  # of unit noise
    assert np.allclose(full.noise_amplification, spread)
    for cut in (reconstructor(D, condition=10), reconstructor(D, kept=3)):
        assert cut.kept == 3
        assert cut.condition_number == pytest.approx(8)
        assert np.allclose(cut.singular_values, values)
        assert np.allclose(cut.matrix, right[:, :3] / values[:3] @ left[:, :3].T)


def test_bad_interaction_matrices_are_refused():
    D = interaction(6, 4)
    blind, twin, many = D.copy(), np.hstack([D, D[:, :1]]), np.zeros((12, 9))
    blind[:, [1, 3]], many[:, 0] = 0, 1
    broken = np.where(D == D[0, 0], np.nan, D)
    require_refusals(
        [
            (lambda: reconstructor(blind), ProblemError, "none from modes 1 and 3 of 4"),
            (lambda: reconstructor(many), ProblemError, "1, 2, 3, 4, 5 and 3 more"),
            (lambda: reconstructor(D.T), DimensionError, "at least as many slopes as modes, 6"),
            (lambda: reconstructor(broken), NonFiniteError, "finite"),
            (lambda: reconstructor(twin), ProblemError, "give the same slopes"),
            (lambda: reconstructor(D, kept=2, condition=3), ProblemError, "not both"),
            (lambda: reconstructor(D, condition=0.5), ProblemError, "condition must be at least 1"),
            (lambda: reconstructor(D, kept=0), ProblemError, "kept must be at least 1"),
            (lambda: reconstructor(D, kept=5), ProblemError, "must not vanish"),
            (lambda: reconstructor(np.zeros((0, 3))), DimensionError, "rows and columns"),
        ]
    )
    assert reconstructor(twin, kept=4).kept == 4


def test_projection_by_gram_schmidt():
    rng = np.random.default_rng(0)
    modes, w = rng.standard_normal((40, 6)), rng.uniform(0, 1, 40)
    clean = project_out(modes, weights=w)
    assert np.array_equal(clean[:, :2], modes[:, :2])
    base = np.linalg.qr(np.sqrt(w)[:, None] * modes[:, :2])[0]
    expected = np.sqrt(w)[:, None] * modes[:, 2:]
    expected -= base @ (base.T @ expected)
    assert np.allclose(np.sqrt(w)[:, None] * clean[:, 2:], expected, atol=1e-12)


def test_projection_through_the_mirror_is_that_of_its_phase():
    rng = np.random.default_rng(1)
    influence, commands = rng.standard_normal((50, 8)), rng.standard_normal((8, 5))
    clean = project_out(commands, [4, 0], influence_matrix=influence)
    assert np.allclose(influence @ clean, project_out(influence @ commands, [4, 0]), atol=1e-10)


def test_bad_projections_are_refused():
    modes = interaction(20, 4)
    twins, spanned = modes.copy(), modes.copy()
    twins[:, 1] = 2 * twins[:, 0]
    spanned[:, 3] = spanned[:, 0] - spanned[:, 1]
    short, wide = np.ones(4), np.ones((30, 3))
    require_refusals(
        [
            (lambda: project_out(modes, [0, 4]), ProblemError, "different mode numbers from 0 to"),
            (lambda: project_out(modes, [1, 1]), ProblemError, "different mode numbers"),
            (lambda: project_out(modes, []), ProblemError, "at least one mode"),
            (lambda: project_out(modes, 1), ProblemError, "list of mode numbers"),
            (lambda: project_out(modes, weights=short), DimensionError, "weights must have shape"),
            (lambda: project_out(modes, weights=-np.ones(20)), ProblemError, "weights must be at"),
            (lambda: project_out(modes, influence_matrix=wide), DimensionError, "have 20 columns"),
            (lambda: project_out(twins), ProblemError, "independent"),
            (lambda: project_out(spanned), ProblemError, "nothing is left of mode 3"),
        ]
    )
