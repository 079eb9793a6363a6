"""Reconstructors, and modes made orthogonal to others."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.interaction import interaction

import lbt_synth as lbt
from lbt_synth.design.modal import project_out, reconstructor


@given(q=st.integers(1, 12), n=st.integers(1, 12), seed=st.integers(0, 100))
def test_inverse_is_that_of_numpy(q, n, seed):
    D = interaction(q, n, seed)
    kept = min(q, n)
    made = reconstructor(D, kept=kept)
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
    for cut in (
        reconstructor(D, condition=10),
        reconstructor(D, kept=3),
    ):
        assert cut.kept == 3
        assert cut.condition_number == pytest.approx(8)
        assert np.allclose(cut.singular_values, values)
        expected = right[:, :3] / values[:3] @ left[:, :3].T
        assert np.allclose(cut.matrix, expected)
        assert np.all(cut.noise_amplification < full.noise_amplification)
    noise = np.random.default_rng(0).standard_normal((200_000, 6))
    spread = (noise @ full.matrix.T).std(axis=0)
    assert np.allclose(spread, full.noise_amplification, rtol=0.01)


def test_bad_interaction_matrices_are_refused():
    D = interaction(6, 4)
    blind = D.copy()
    blind[:, [1, 3]] = 0
    with pytest.raises(lbt.errors.ProblemError, match="none from modes 1 and 3 of 4"):
        reconstructor(blind)
    with pytest.raises(lbt.errors.DimensionError, match="at least as many slopes as modes, 6"):
        reconstructor(D.T)
    with pytest.raises(lbt.errors.NonFiniteError):
        reconstructor(np.where(D == D[0, 0], np.nan, D))
    twin = np.hstack([D, D[:, :1]])
    with pytest.raises(lbt.errors.ProblemError, match="give the same slopes"):
        reconstructor(twin)
    assert reconstructor(twin, kept=4).kept == 4
    with pytest.raises(lbt.errors.ProblemError, match="not both"):
        reconstructor(D, kept=2, condition=3)
    with pytest.raises(lbt.errors.ProblemError, match="condition must be at least 1"):
        reconstructor(D, condition=0.5)
    with pytest.raises(lbt.errors.ProblemError, match="kept must be at least 1"):
        reconstructor(D, kept=0)
    with pytest.raises(lbt.errors.ProblemError, match="must not vanish"):
        reconstructor(D, kept=5)
    with pytest.raises(lbt.errors.DimensionError):
        reconstructor(np.zeros((0, 3)))
    blind_many = np.zeros((12, 9))
    blind_many[:, 0] = 1
    with pytest.raises(lbt.errors.ProblemError, match="1, 2, 3, 4, 5 and 3 more"):
        reconstructor(blind_many)


def test_projection_by_gram_schmidt():
    rng = np.random.default_rng(0)
    modes, w = rng.standard_normal((40, 6)), rng.uniform(0, 1, 40)
    clean = project_out(modes, weights=w)
    assert np.array_equal(clean[:, :2], modes[:, :2])
    base = np.linalg.qr(np.sqrt(w)[:, None] * modes[:, :2])[0]
    expected = np.sqrt(w)[:, None] * modes[:, 2:]
    expected -= base @ (base.T @ expected)
    assert np.allclose(np.sqrt(w)[:, None] * clean[:, 2:], expected, atol=1e-12)
    assert np.allclose(project_out(clean, weights=w), clean, atol=1e-12)


def test_projection_through_the_mirror_is_that_of_its_phase():
    rng = np.random.default_rng(1)
    influence, commands = rng.standard_normal((50, 8)), rng.standard_normal((8, 5))
    clean = project_out(commands, [4, 0], influence_matrix=influence)
    assert np.allclose(influence @ clean, project_out(influence @ commands, [4, 0]), atol=1e-10)


def test_bad_projections_are_refused():
    modes = interaction(20, 4)
    with pytest.raises(lbt.errors.ProblemError, match="different mode numbers from 0 to 3"):
        project_out(modes, [0, 4])
    with pytest.raises(lbt.errors.ProblemError, match="different mode numbers"):
        project_out(modes, [1, 1])
    with pytest.raises(lbt.errors.ProblemError, match="at least one mode"):
        project_out(modes, [])
    with pytest.raises(lbt.errors.ProblemError, match="list of mode numbers"):
        project_out(modes, 1)
    with pytest.raises(lbt.errors.DimensionError, match="weights must have shape"):
        project_out(modes, weights=np.ones(4))
    with pytest.raises(lbt.errors.ProblemError, match="weights must be at least 0"):
        project_out(modes, weights=-np.ones(20))
    with pytest.raises(lbt.errors.DimensionError, match="influence_matrix must have 20 columns"):
        project_out(modes, influence_matrix=np.ones((30, 3)))
    twins = modes.copy()
    twins[:, 1] = 2 * twins[:, 0]
    with pytest.raises(lbt.errors.ProblemError, match="independent"):
        project_out(twins)
    spanned = modes.copy()
    spanned[:, 3] = spanned[:, 0] - spanned[:, 1]
    with pytest.raises(lbt.errors.ProblemError, match="nothing is left of mode 3"):
        project_out(spanned)
