"""H2 control below a level of the H-infinity norm with one Lyapunov matrix for both norms.

C. Scherer, P. Gahinet, M. Chilali, IEEE Trans. Autom. Control 42, 896 (1997),
doi:10.1109/9.599969, in discrete time.
"""

from dataclasses import replace

import cvxpy as cp
import numpy as np


def common_lyapunov_rms(plant, gamma):
    """Bound on the standard deviation that the inequality proves, which it cannot lower."""
    P, n = plant, len(plant.A)
    m1, m2, p1, p2 = P.sizes
    P = replace(P, C1=P.C1 / gamma, D11=P.D11 / gamma, D12=P.D12 / gamma)
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    A, B, C, D = (cp.Variable(size) for size in ((n, n), (n, p2), (m2, n), (m2, p2)))
    W = cp.Variable((p1, p1), symmetric=True)
    J = cp.bmat([[X, np.eye(n)], [np.eye(n), Y]])
    AT = cp.bmat([[P.A @ X + P.B2 @ C, P.A + P.B2 @ D @ P.C2], [A, Y @ P.A + B @ P.C2]])
    BT = cp.vstack([P.B1 + P.B2 @ D @ P.D21, Y @ P.B1 + B @ P.D21])
    CT = cp.hstack([P.C1 @ X + P.D12 @ C, P.C1 + P.D12 @ D @ P.C2])
    DT = P.D11 + P.D12 @ D @ P.D21
    none, across = np.zeros((2 * n, p1)), np.zeros((2 * n, m1))
    norm = [
        [J, AT, BT, none],
        [AT.T, J, across, CT.T],
        [BT.T, across.T, np.eye(m1), DT.T],
        [none.T, CT, DT, np.eye(p1)],
    ]
    decay = [[J, AT, BT], [AT.T, J, across], [BT.T, across.T, np.eye(m1)]]
    output = [[W, CT, DT], [CT.T, J, across], [DT.T, across.T, np.eye(m1)]]
    blocks = [cp.bmat(rows) for rows in (norm, decay, output)]
    programme = cp.Problem(cp.Minimize(cp.trace(W)), [(M + M.T) / 2 >> 0 for M in blocks])
    programme.solve(solver=cp.CLARABEL, tol_gap_rel=1e-5, tol_gap_abs=1e-5, tol_feas=1e-6)
    return gamma * float(np.sqrt(programme.value))
