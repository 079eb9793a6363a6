"""An H-infinity controller from two Riccati equations with an indefinite weight.

The data are those of the example in the documentation of SLICOT's SB10DD. The formulas are
those of M. Green and D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995): the
first equation is that of full information, the second that of a filter for the plant that
is left. `solve_dare` checks the conditions of existence of both.

Run: python examples/output_feedback.py
"""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt

A = np.array(
    [
        [-0.7, 0.0, 0.3, 0.0, -0.5, -0.1],
        [-0.6, 0.2, -0.4, -0.3, 0.0, 0.0],
        [-0.5, 0.7, -0.1, 0.0, 0.0, -0.8],
        [-0.7, 0.0, 0.0, -0.5, -1.0, 0.0],
        [0.0, 0.3, 0.6, -0.9, 0.1, -0.4],
        [0.5, -0.8, 0.0, 0.0, 0.2, -0.9],
    ]
)
B = np.array(
    [
        [-1.0, -2.0, -2.0, 1.0, 0.0],
        [1.0, 0.0, 1.0, -2.0, 1.0],
        [-3.0, -4.0, 0.0, 2.0, -2.0],
        [1.0, -2.0, 1.0, 0.0, -1.0],
        [0.0, 1.0, -2.0, 0.0, 3.0],
        [1.0, 0.0, 3.0, -1.0, -2.0],
    ]
)
C = np.array(
    [
        [1.0, -1.0, 2.0, -2.0, 0.0, -3.0],
        [-3.0, 0.0, 1.0, -1.0, 1.0, 0.0],
        [0.0, 2.0, 0.0, -4.0, 0.0, -2.0],
        [1.0, -3.0, 0.0, 0.0, 3.0, 1.0],
        [0.0, 1.0, -2.0, 1.0, 0.0, -2.0],
    ]
)
D = np.array(
    [
        [1.0, -1.0, -2.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 1.0, 0.0],
        [2.0, -1.0, -3.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, 1.0, -1.0],
        [0.0, 0.0, 1.0, 2.0, 1.0],
    ]
)
CONTROLS, MEASUREMENTS, GAMMA = 2, 2, 111.294


def central_controller(A, B, C, D, *, controls, measurements, gamma):
    """Return the matrices of the central controller with a closed-loop norm below gamma."""
    m1, p1 = B.shape[1] - controls, C.shape[0] - measurements
    B1, B2, C1, C2 = B[:, :m1], B[:, m1:], C[:p1], C[p1:]
    D1, D21, D22 = D[:p1], D[p1:, :m1], D[p1:, m1:]

    level = np.diag(np.r_[np.full(m1, gamma**2), np.zeros(controls)])
    weight, cross = D1.T @ D1 - level, C1.T @ D1
    X = lbt.solve_dare(A, B, C1.T @ C1, weight, cross).X
    R, F = weight + B.T @ X @ B, cross.T + B.T @ X @ A
    R1, R2, R3, F1, F2 = R[:m1, :m1], R[m1:, :m1], R[m1:, m1:], F[:m1], F[m1:]
    worst = R1 - R2.T @ np.linalg.solve(R3, R2)  # negative definite
    push = np.linalg.solve(worst, F1 - R2.T @ np.linalg.solve(R3, F2))
    V = np.linalg.cholesky(R3).T
    spread = gamma * np.linalg.inv(np.linalg.cholesky(-worst).T)

    At, Bt = A - B1 @ push, B1 @ spread
    Ct = np.vstack([np.linalg.solve(V.T, F2 - R2 @ push), C2 - D21 @ push])
    Dt = np.vstack([np.linalg.solve(V.T, R2), D21]) @ spread
    level = np.diag(np.r_[np.full(controls, gamma**2), np.zeros(measurements)])
    weight, cross = Dt @ Dt.T - level, Bt @ Dt.T
    Z = lbt.solve_dare(At.T, Ct.T, Bt @ Bt.T, weight, cross).X
    S, M = weight + Ct @ Z @ Ct.T, cross + At @ Z @ Ct.T
    correction = np.linalg.solve(S[controls:, controls:], S[controls:, :controls]).T
    gain = np.linalg.solve(S[controls:, controls:], M[:, controls:].T).T

    DK = -np.linalg.solve(V, correction)
    CK = -np.linalg.solve(V, Ct[:controls] - correction @ Ct[controls:])
    AK, BK = At + B2 @ CK - gain @ Ct[controls:], gain + B2 @ DK
    feedthrough = np.linalg.inv(np.eye(controls) + DK @ D22)  # the plant's own
    CK, DK = feedthrough @ CK, feedthrough @ DK
    return AK - BK @ D22 @ CK, BK @ (np.eye(measurements) - D22 @ DK), CK, DK


def closed_loop(A, B, C, D, controller, *, controls, measurements):
    """Return the system from disturbances to controlled outputs."""
    AK, BK, CK, DK = controller
    m1, p1 = B.shape[1] - controls, C.shape[0] - measurements
    B1, B2, C1, C2 = B[:, :m1], B[:, m1:], C[:p1], C[p1:]
    D11, D12, D21, D22 = D[:p1, :m1], D[:p1, m1:], D[p1:, :m1], D[p1:, m1:]
    E = np.linalg.inv(np.eye(controls) - DK @ D22)
    Ux, Uk, Uw = E @ DK @ C2, E @ CK, E @ DK @ D21  # u = Ux x + Uk xk + Uw w
    Yx, Yk, Yw = C2 + D22 @ Ux, D22 @ Uk, D21 + D22 @ Uw
    return lbt.linear.StateSpace(
        A=np.block([[A + B2 @ Ux, B2 @ Uk], [BK @ Yx, AK + BK @ Yk]]),
        B=np.vstack([B1 + B2 @ Uw, BK @ Yw]),
        C=np.hstack([C1 + D12 @ Ux, D12 @ Uk]),
        D=D11 + D12 @ Uw,
    )


def main() -> None:
    """Print the controller and the norm that it achieves."""
    sizes = {"controls": CONTROLS, "measurements": MEASUREMENTS}
    controller = central_controller(A, B, C, D, gamma=GAMMA, **sizes)
    with np.printoptions(precision=4, suppress=True, linewidth=100):
        for name, matrix in zip(("AK", "BK", "CK", "DK"), controller, strict=True):
            print(f"{name} =\n{matrix}")
    loop = closed_loop(A, B, C, D, controller, **sizes)
    norm = lbt.hinf_norm(loop)
    print(f"spectral radius of the closed loop {loop.spectral_radius:.6f}")
    print(f"its norm {norm.value:.6f}, asked for less than {GAMMA}")


if __name__ == "__main__":
    main()
