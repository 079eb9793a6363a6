"""Random loops against oracles written from their definitions, which use no room but the models.

    python benchmarks/independent_oracles.py [40]

Residuals are integrated over densities and responses; Strehl ratios over the transfer function of
a pupil of pixels; the limit is the least square of 500 taps; poles are those of matrices of the
loop's own equations, with complex gains, further delays, and gains that move.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import j0

import lbt_synth as lbt

TRIALS, FINDINGS = Counter[str](), Counter[str]()
RNG = np.random.Generator


def check(what: str, holds: bool, seed: int) -> None:
    """Count a trial, and name the loop of a finding."""
    TRIALS[what] += 1
    if not holds:
        FINDINGS[what] += 1
        print(f"  loop {seed}: {what}", flush=True)


def log(rng: RNG, low: float, high: float) -> float:
    """Return a random number, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw(rng: RNG, modes: int) -> tuple[lbt.LoopHardware, lbt.Truth]:
    """Return a random loop and its truth; delays have fractions."""
    rate = log(rng, 100, 3000)
    lines = []
    for _ in range(rng.integers(1, 4)):
        direction = rng.standard_normal(modes)
        direction /= np.linalg.norm(direction)
        size = {"rms_nm": log(rng, 1, 300), "direction": tuple(direction)}
        size["frequency_hz"] = log(rng, 0.005, 0.45) * rate
        if rng.random() < 0.3:
            lines.append(lbt.models.SinusoidalVibration(**size))
        else:
            lines.append(lbt.Vibration(damping=log(rng, 1e-3, 0.5), **size))
    air = lbt.models.ARModel(
        coefficients=[1 - log(rng, 1e-2, 0.1)], driving_rms_nm=log(rng, 1, 100), frame_rate_hz=rate
    )
    path = lbt.LoopHardware(
        frame_rate_hz=rate,
        delay_frames=float(rng.choice([1, 2, 3, *rng.uniform(1, 3.5, 3)])),
        sensor_matrix=np.diag(rng.uniform(0.3, 1.5, modes)),
        influence_matrix=np.eye(modes) + 0.1 * rng.standard_normal((modes, modes)),
    )
    noise, gain = rng.uniform(0.5, 50, modes), rng.uniform(0.4, 1.2)
    return path, lbt.Truth(
        turbulence=air, vibrations=tuple(lines), noise_nm=noise, sensor_gain=gain
    )


def controllers(rng: RNG, path: lbt.LoopHardware) -> Iterator[lbt.Controller]:
    """Yield leaky integrators with a second pole."""
    inverse = np.linalg.inv(path.sensor @ path.influence)
    one = np.eye(path.modes)
    while True:
        gain, leak, pole = log(rng, 0.02, 0.5), rng.choice([1.0, 0.99, 0.9]), rng.uniform(-0.3, 0.3)
        yield lbt.Controller(
            A=np.kron(np.diag([leak, pole]), one),
            B=np.vstack([gain * inverse, 0.1 * gain * inverse]),
            C=np.hstack([one, one]),
            D=0 * one,
            dt_s=1 / path.frame_rate_hz,
        )


def taps_of(path: lbt.LoopHardware, further: float = 0.0) -> np.ndarray:
    """Return the weights of u(k), u(k-1), .. in a correction, with a further delay."""
    whole, part = divmod(path.delay_frames + further - 1, 1)
    return np.array([*np.zeros(int(whole)), 1 - part, part])


def responses(
    path: lbt.LoopHardware, own: lbt.Controller, gain: float, f: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the responses (f, n, n) from phase and from noise to the residual."""
    z = np.exp(2j * np.pi * f / path.frame_rate_hz)[:, None, None]
    taps = taps_of(path)
    late = sum(tap * z**-j for j, tap in enumerate(taps))
    inner = np.linalg.solve(z * np.eye(len(own.A)) - own.A, own.B + 0 * z)
    chain = path.influence @ (z * (own.C @ inner) + own.D) * late
    S = np.linalg.inv(np.eye(path.modes) + gain * chain @ path.sensor / z)
    return S, -S @ chain


def density(coefficients: np.ndarray, driving_nm: float, f: np.ndarray, rate: float) -> np.ndarray:
    """Return the one-sided spectrum of an autoregressive process [nm^2/Hz]."""
    z = np.exp(-2j * np.pi * f / rate)
    poles = 1 - sum(a * z ** (i + 1) for i, a in enumerate(coefficients))
    return 2 * driving_nm**2 / rate / np.abs(poles) ** 2


def line_density(line: lbt.Vibration, f: np.ndarray, rate: float) -> np.ndarray:
    """Return the spectrum of a sampled resonance [nm^2/Hz]."""
    turn, k = 2 * np.pi * line.frequency_hz / rate, line.damping
    a = 2 * np.exp(-k * turn) * np.cos(turn * np.sqrt(1 - k * k))
    b = -np.exp(-2 * k * turn)
    drive = np.sqrt((1 + b) * ((1 - b) ** 2 - a**2) / (1 - b))
    return density(np.array([a, b]), line.rms_nm * drive, f, rate)


def integrate(
    path: lbt.LoopHardware, own: lbt.Controller, truth: lbt.Truth
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the covariance (n, n) of what is random, and the amplitudes of sinusoids."""
    rate = path.frame_rate_hz
    edges = [*np.linspace(0, rate / 2, 400), *np.geomspace(1e-6 * rate, rate / 2, 200)]
    for line in truth.vibrations:
        if isinstance(line, lbt.Vibration):
            steps = line.damping * 10.0 ** np.arange(-3, 4.1, 0.5)
            centre = line.frequency_hz * np.sqrt(1 - line.damping**2)
            edges += [*(centre * (1 + steps)), *(centre * (1 - steps)), centre]
    edges = np.unique(np.clip(edges, 0, rate / 2))
    x, weight = np.polynomial.legendre.leggauss(10)
    half = np.diff(edges)[:, None] / 2
    f, w = (edges[:-1, None] + half * (1 + x)).ravel(), (half * weight).ravel()
    S, N = responses(path, own, truth.sensor_gain, f)
    parts = [(S, density(truth.turbulence.coefficients, truth.turbulence.driving_rms_nm, f, rate))]
    parts.append((N * truth.noise_nm, np.full(f.size, 2 / rate)))
    sinusoids = []
    for line in truth.vibrations:
        direction = np.array(line.direction)[:, None]
        if isinstance(line, lbt.Vibration):
            parts.append((S @ direction, line_density(line, f, rate)))
        else:
            at = responses(path, own, truth.sensor_gain, np.array([line.frequency_hz]))[0][0]
            sinusoids.append((at @ direction)[:, 0] * line.rms_nm * np.sqrt(2))
    covariance = sum(np.einsum("k,kia,kja->ij", w * p, H, H.conj()).real for H, p in parts)
    return covariance, sinusoids


def pixel_strehl(
    covariance: np.ndarray, sinusoids: list[np.ndarray], obstruction: float, um: float
) -> float:
    """Return the Strehl ratio by the autocorrelation of a pupil of 256 pixels."""
    x = (np.arange(512) - 255.5) / 256
    radius = np.hypot(*np.meshgrid(x, x)) * 2
    pupil = ((radius <= 1) & (radius >= obstruction)).astype(float)
    transfer = np.fft.fftshift(np.abs(np.fft.ifft2(np.abs(np.fft.fft2(pupil)) ** 2)))
    base = np.stack(np.meshgrid(*[(np.arange(512) - 256) / 256] * 2))[: len(covariance)]
    turn = 8 * np.pi / (1000 * um)  # rad per nm rms of tilt and diameter
    left = np.exp(-0.5 * turn**2 * np.einsum("iab,ij,jab->ab", base, covariance, base))
    for amplitude in sinusoids:
        left = left * j0(turn * np.abs(np.einsum("iab,i->ab", base, amplitude)))
    return float(np.sum(transfer * left) / np.sum(transfer))


def matrix(
    path: lbt.LoopHardware, own: lbt.Controller, gains: np.ndarray, further: float = 0.0
) -> np.ndarray:
    """Return the matrix of a loop: states, past commands, residual; gains may be complex."""
    taps, n, m, s = taps_of(path, further), path.modes, len(own.C), len(own.A)
    size = s + (len(taps) - 1) * m + n
    A = np.zeros((size, size), dtype=np.result_type(gains, float))
    sensor = np.asarray(gains)[:, None] * path.sensor
    A[:s, :s], A[:s, -n:] = own.A, own.B @ sensor
    command = own.C @ A[:s]
    command[:, -n:] += own.D @ sensor
    for j in range(len(taps) - 1):
        rows = slice(s + j * m, s + (j + 1) * m)
        if j == 0:
            A[rows] = command
        else:
            A[rows, s + (j - 1) * m : s + j * m] = np.eye(m)
    A[-n:] = -path.influence @ (taps[0] * command)
    for j in range(1, len(taps)):
        A[-n:, s + (j - 1) * m : s + j * m] -= taps[j] * path.influence
    return A


def radius(A: np.ndarray) -> float:
    """Return the largest modulus of an eigenvalue."""
    return float(np.abs(np.linalg.eigvals(A)).max())


def attack(seed: int) -> None:
    """Try residual, Strehl ratio and margins of one loop."""
    rng = np.random.default_rng([4242, seed])
    path, truth = draw(rng, int(rng.integers(1, 3)))
    own = next(
        each
        for each in controllers(rng, path)
        if lbt.close_loop(path, each, sensor_gain=truth.sensor_gain).is_stable
    )
    loop = lbt.close_loop(path, own, sensor_gain=truth.sensor_gain)
    gains = np.full(path.modes, truth.sensor_gain)
    check(
        "spectral radius", abs(radius(matrix(path, own, gains)) - loop.spectral_radius) < 1e-7, seed
    )
    budget = lbt.residual_budget(loop, truth, frame_means=True)
    covariance, sinusoids = integrate(path, own, truth)
    total = np.trace(covariance) + sum(np.sum(np.abs(a) ** 2) / 2 for a in sinusoids)
    check("residual", abs(total / budget.rms_nm**2 - 1) < 2e-5, seed)
    um, obstruction = float(rng.choice([0.5, 1.65, 2.2])), float(rng.choice([0, 0.11, 0.3]))
    imaging = lbt.Imaging(diameter_m=8.22, obstruction=obstruction, wavelength_um=um)
    exact = lbt.strehl(budget, imaging)
    error = abs(exact - pixel_strehl(covariance, sinusoids, obstruction, um))
    check("Strehl ratio", error < 0.006 + 0.01 * exact, seed)
    margins = lbt.loop_margins(loop)
    longest = min(margins.delay_frames, 15.0)
    below = [radius(matrix(path, own, gains, d)) for d in np.linspace(0, longest, 400)[1:-1]]
    check("stable below the delay margin", max(below) < 1 + 1e-9, seed)
    if margins.delay_frames < 15:
        beyond = radius(matrix(path, own, gains, 1.01 * margins.delay_frames))
        check("unstable 1 % beyond the delay margin", beyond >= 1, seed)
    for _ in range(60):
        part = 0.4995 * margins.disk * np.exp(2j * np.pi * rng.uniform(size=path.modes))
        turned = gains * (1 + part) / (1 - part)
        check("complex gains in the disk", radius(matrix(path, own, turned)) < 1 + 1e-9, seed)


def attack_limit(seed: int) -> None:
    """Compare the limit of performance with the least square of 500 taps."""
    rng = np.random.default_rng([21, seed])
    path, truth = draw(rng, 1)
    lines = tuple(  # that 500 frames can resolve
        lbt.Vibration(
            frequency_hz=max(one.frequency_hz, 0.02 * path.frame_rate_hz),
            damping=log(rng, 0.05, 0.4),
            rms_nm=one.rms_nm,
            direction=(1.0,),
        )
        for one in truth.vibrations
    )
    truth = replace(truth, vibrations=lines)
    limit = lbt.loop.least_residual(path, truth, frame_means=True).rms_nm ** 2
    f = np.arange((1 << 16) + 1) * path.frame_rate_hz / (1 << 17)
    air = truth.turbulence
    whole = density(air.coefficients, air.driving_rms_nm, f, path.frame_rate_hz)
    whole += sum(line_density(one, f, path.frame_rate_hz) for one in truth.vibrations)
    R = np.fft.irfft(whole) * path.frame_rate_hz / 2
    gain, taps = truth.sensor_gain * path.sensor[0, 0], taps_of(path) * path.influence[0, 0]
    n, noise = np.arange(500), float(truth.noise_nm[0])
    column, cross = np.zeros(500), np.zeros(500)
    for i, one in enumerate(taps):
        cross += one * gain * R[n + i + 1]
        for j, other in enumerate(taps):
            apart = n - (i - j)
            column += one * other * (gain**2 * R[np.abs(apart)] + noise**2 * (apart == 0))
    best = np.linalg.solve(toeplitz(column) + 1e-13 * column[0] * np.eye(500), cross)
    own = R[0] - cross @ best
    check("no 500 taps are below the limit", own >= limit * (1 - 1e-5), seed)
    check("500 taps reach the limit", own <= limit * (1 + 2e-3), seed)


def attack_moving_gain(seed: int) -> None:
    """Search sequences of gains in a proved interval for one that destabilises."""
    rng = np.random.default_rng([13, seed])
    path = draw(rng, 1)[0]
    own = next(c for c in controllers(rng, path) if lbt.close_loop(path, c).is_stable)
    moving = lbt.loop.moving_gain(lbt.close_loop(path, own))
    low, high = moving.moving_low, moving.moving_high

    def growth(word: np.ndarray) -> float:
        product = np.eye(len(matrix(path, own, np.ones(1))))
        for gain in word:
            product = matrix(path, own, np.array([gain])) @ product
        return radius(product) ** (1 / len(word))

    for length in rng.integers(1, 40, 3) if np.isfinite(low) else ():
        word = rng.choice([low, high], length)
        worst = growth(word)
        for _ in range(60):
            other, at = word.copy(), rng.integers(len(word))
            other[at] = rng.choice([low, high, rng.uniform(low, high)])
            if (tried := growth(other)) > worst:
                word, worst = other, tried
        check("gains that move in the proved interval", worst < 1 + 1e-9, seed)


if __name__ == "__main__":
    for number in range(int(sys.argv[1]) if len(sys.argv) > 1 else 40):
        attack(number)
        attack_limit(number)
        attack_moving_gain(number)
    for name, count in TRIALS.items():
        print(f"{name}: {count} trials, {FINDINGS[name]} findings")
