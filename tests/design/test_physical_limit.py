"""Filters of wavefront and accelerometer against the limit of the continuous oscillator.

The limit is that of a Kalman filter of an oscillator that is kicked within each frame, and the
loop's residual that on this oscillator: neither comes from the package.
"""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from support.oscillators import KickedOscillator

import lbt_synth as lbt

RATE_HZ, RMS_NM, NOISE_NM = 800.0, 563.6, 77.5
# almost none: 3e-9 of the least residual's power
AIR = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=2e-4, frame_rate_hz=RATE_HZ)


def designed(frequency_hz, damping, noise, age):
    """Return the Kalman filter of a loop of two frames; the noise is over w^2 times the rms."""
    line = lbt.Vibration(
        frequency_hz=frequency_hz, damping=damping, rms_nm=RMS_NM, direction=(1.0,)
    )
    own = lbt.tip_tilt_plant(
        frame_rate_hz=RATE_HZ, turbulence=AIR, vibrations=[line], noise_nm=NOISE_NM, modes=1
    )
    channel = lbt.models.Accelerometer(
        name="mirror",
        rate_hz=RATE_HZ,
        delay_frames=1 + age,
        channels=("m1",),
        noise_m_s2=1e-9 * noise * (2 * np.pi * frequency_hz) ** 2 * RMS_NM,
    )
    suite = lbt.models.SensorSuite(sensors=(channel,))
    return lbt.kalman(own.with_sensors(suite, ({"m1": lbt.models.Motion(size=1)},)))


def physics(frequency_hz, damping, noise, age):
    """Return A, B, C, R of the oscillator: readings over 1e-9 w^2, and the positions' rows."""
    angle, whole = 2 * np.pi * frequency_hz / RATE_HZ, int(age)
    oscillator = KickedOscillator(angle, damping, RMS_NM, steps=8)
    A, B = oscillator.chain(1 - (age - whole), whole + 2)
    C = np.zeros((2, len(A)))
    C[0, 3] = 1.0  # the mean position in the frame before
    C[1, [5 + 2 * whole, 7 + 2 * whole]] = np.array([1, -1]) / angle
    return A, B, C, np.diag([NOISE_NM, noise * RMS_NM]) ** 2


def least_nm(A, B, C, R):
    """Return what any linear filter leaves of the position that the next command meets."""
    return float(np.sqrt(solve_discrete_are(A.T, C.T, B @ B.T, R)[2, 2]))


def left_nm(design, A, B, C, R):
    """Return what the loop of a design leaves of the oscillator: phase(k) - u(k - 1)."""
    k = design.controller
    K, L, M, n, s = k.A, k.B, k.C, len(A), k.n_states
    units = np.array([1.0, 1e-9 * (2 * np.pi * design.problem.vibrations[0].frequency_hz) ** 2])
    L = L * units
    # states: the oscillator's, the controller's before y(k), u(k - 1), u(k - 2)
    whole, drive = np.zeros((n + s + 2,) * 2), np.zeros((n + s + 2, B.shape[1] + 2))
    whole[:n, :n], drive[:n, : B.shape[1]] = A, B
    y = np.zeros((2, n + s + 2))
    y[:, :n], y[0, -1] = C, -1.0
    rows = slice(n, n + s)
    whole[rows], drive[rows, B.shape[1] :] = L @ y, L @ np.sqrt(R)
    whole[rows, rows] += K
    whole[-2], drive[-2] = (M @ whole[rows])[0], (M @ drive[rows])[0]
    whole[-1, -2] = 1.0
    P = solve_discrete_lyapunov(whole, drive @ drive.T)
    row = np.zeros(len(P))
    row[2], row[-2] = 1.0, -1.0
    return float(np.sqrt(row @ P @ row))


def random_case(seed):
    rng = np.random.default_rng([seed, 7])
    frequency_hz = float(rng.uniform(5, 200))
    damping, noise = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), 2)).tolist()
    return frequency_hz, damping, noise, [0.0, 0.0, 0.375, 1.25][seed % 4]


@pytest.mark.parametrize("seed", range(100))
def test_no_certified_residual_is_below_that_of_physics(seed):
    case = random_case(seed)
    design, model = designed(*case), physics(*case)
    least, left = least_nm(*model), left_nm(design, *model)
    assert design.certificate.passed
    assert design.rms > least * (1 - 1e-6)
    assert left > least * (1 - 1e-6)
    assert design.rms == pytest.approx(left, rel=1e-6)


@pytest.mark.parametrize(
    ("case", "expected_nm"), [((60.0, 0.05, 0.01, 0.0), 55.64), ((150.0, 0.03, 0.001, 0.0), 96.42)]
)
def test_two_lines_that_used_to_be_known_in_advance(case, expected_nm):
    """The second difference of the frame to come left 39 and 33 nm of them."""
    design = designed(*case)
    assert design.rms == pytest.approx(least_nm(*physics(*case)), rel=1e-6)
    assert round(design.rms, 2) == expected_nm
