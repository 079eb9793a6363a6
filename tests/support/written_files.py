"""Exported files judged by themselves: read by other code, and run in the target's arithmetic.

Nothing here uses what the package proves an export with. The loop is one plain function of a
frame. Transfer functions are judged in exact numbers, by the recursion of Schur and Cohn.
"""

import math
from fractions import Fraction

import numpy as np
from astropy.io import fits
from ruamel.yaml import YAML
from scipy.io import loadmat
from support.compiled import Compiled

import lbt_synth as lbt
from lbt_synth.interop.pyrtc.plugin import GainFilePredictor

FRAMES = 1000
SINGLE = {"single": np.float32, "double": np.float64}


def random_design(rng):
    """A quick design for any loop: rate, delay, axes, lines from 0.5 Hz up, damping from 1e-5."""
    rate, modes = float(10 ** rng.uniform(2, 3.5)), int(rng.integers(1, 3))
    delay = float(rng.choice([1, 2, 3, rng.uniform(1, 4)], p=[0.15, 0.45, 0.15, 0.25]))
    kind = rng.choice(["kalman", "hinf", "law", "shaped"], p=[0.6, 0.23, 0.15, 0.02])
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=delay, modes=modes)
    if kind == "law":
        changes = {
            "leak": float(rng.choice([1.0, rng.uniform(0.9, 1)])),
            "zero_hz": rng.choice([None, rng.uniform(0.001, 0.05) * rate]),
        }
        if changes["zero_hz"] is not None:
            changes["integrators"] = int(rng.integers(1, 3))
        if rng.random() < 0.7:
            law = lbt.design.IntegratorLaw(modulus_margin=float(rng.uniform(0.2, 0.8)), **changes)
            return lbt.integrator(path, law=law)
        law = lbt.design.IntegratorLaw(**changes)
        return lbt.integrator(path, gain=float(10 ** rng.uniform(-2, 0)), law=law)
    noise = float(10 ** rng.uniform(-1, 2.5))
    slow = turbulence(rng, rate)
    if kind == "shaped":
        air = lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=noise)
        margin = lbt.design.shaping.ModulusMargin(at_least=float(rng.uniform(0.3, 0.6)))
        spec = lbt.design.shaping.Specification(objective=air, demands=[margin])
        return lbt.design.shape(path, spec, functions=int(rng.integers(4, 16)), states=None)
    lines = [
        lbt.Vibration(
            frequency_hz=float(np.exp(rng.uniform(np.log(0.5), np.log(0.45 * rate)))),
            damping=float(10 ** rng.uniform(-5, -1)),
            rms_nm=float(10 ** rng.uniform(0, 3)),
            direction=tuple(np.eye(modes)[rng.integers(modes)]),
        )
        for _ in range(rng.integers(0, 5))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=rate,
        delay_frames=delay,
        turbulence=slow,
        noise_nm=noise,
        vibrations=lines or None,
        modes=modes,
    )
    if kind == "hinf":
        return lbt.hinf(plant, gamma_ratio=float(rng.uniform(1.02, 3)), route="riccati")
    return lbt.kalman(plant)


def turbulence(rng, rate):
    """A process of the first or of the second order."""
    pole = 1 - 10 ** rng.uniform(-4, -1)
    if rng.random() < 0.5:
        coefficients = [pole]
    else:
        angle = 2 * np.pi * 10 ** rng.uniform(-1, 1) / rate
        coefficients = [2 * pole * np.cos(angle), -(pole**2)]
    size = float(10 ** rng.uniform(0, 2))
    return lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=size, frame_rate_hz=rate)


def random_options(name, rng):
    """Options of an export that change what is written."""
    if name == "c":
        return {
            "form": str(rng.choice(["plain", "estimator"])),
            "precision": str(rng.choice(list(SINGLE))),
        }
    if name == "cacao":
        return {} if rng.random() < 0.7 else {"steps": int(rng.integers(8, 400))}
    return {}


def taps(hardware):
    """Weights of u(k), u(k-1), .. in the correction of frame k, for a mirror that settles."""
    whole = math.floor(hardware.delay_frames - 1)
    part = hardware.delay_frames - 1 - whole
    return [0.0] * whole + [1 - part, part]


class Loop:
    """A loop of unit sensor and mirror around ``step(state, y, last) -> state, u``."""

    def __init__(self, hardware, states, step):
        self.taps, self.modes = taps(hardware), hardware.modes
        self.states, self.step = states, step

    def frame(self, s):
        """Take the state of the loop: of the controller, past commands, the last residual."""
        n, m = self.states, self.modes
        x, residual = s[:n], s[-m:]
        past = list(s[n:-m].reshape(-1, m))
        x, u = self.step(x, residual, past[0])
        past = [u, *past[: len(self.taps) - 1]]
        residual = -sum(c * v for c, v in zip(self.taps, past, strict=True))
        return np.concatenate([x, *past, residual])

    def radius(self):
        """Largest modulus of an eigenvalue."""
        each = np.eye(self.states + (len(self.taps) + 1) * self.modes)
        return np.max(np.abs(np.linalg.eigvals(np.stack([self.frame(e) for e in each], axis=1))))


def decays(hardware, step):
    """Whether a loop in any arithmetic comes back from a kick: ``step(y, last) -> u``.

    A slow line may still swing up when the first frames are over.
    """
    m = hardware.modes
    past, residual = [np.zeros(m)] * len(taps(hardware)), 100.0 * np.ones(m)
    sizes = []
    for frames in (FRAMES, 16 * FRAMES):
        while len(sizes) < frames:
            past = [step(residual, past[0]), *past[:-1]]
            residual = -sum(c * v for c, v in zip(taps(hardware), past, strict=True))
            sizes.append(np.max(np.abs(residual)))
        late = np.max(sizes[-frames // 4 :])
        if np.isfinite(sizes).all() and late <= 1.001 * np.max(sizes[: -frames // 4]):
            return True
    return False


def judge_c(files, design, options):
    """Probe the compiled source with unit vectors, close the loop, and run it."""
    theirs = Compiled(files[0], single=options["precision"] == "single")
    m, n = len(theirs.u), theirs.state.size - len(theirs.u)
    given = options["form"] == "estimator"

    def step(x, y, last):
        theirs.state[:n] = x
        u = theirs.step(y, last) if given else theirs.step(y)
        return theirs.state[:n].astype(float), u

    radius = Loop(design.hardware, n, step).radius()
    theirs.reset()
    run = theirs.step if given else lambda y, last: theirs.step(y)
    return bool(radius < 1 and decays(design.hardware, run) and m == design.hardware.modes)


def judge_matlab(files, design, options):
    """Step ``ss(A, B, C, D)`` as MATLAB does."""
    form = loadmat(files[0])["textbook"][0, 0]
    A, B, C, D = (form[name] for name in "ABCD")
    loop = Loop(design.hardware, len(A), lambda x, y, last: (A @ x + B @ y, C @ x + D @ y))
    state = [np.zeros(len(A))]

    def run(y, last):
        u = C @ state[0] + D @ y
        state[0] = A @ state[0] + B @ y
        return u

    return bool(loop.radius() < 1 and decays(design.hardware, run))


def judge_dao(files, design, options):
    """Take the rows of the matrix, close the loop in exact numbers, and run the recursion."""
    matrix = np.load(files[0])
    order = len(matrix) // 2
    return judge_recursion(
        design.hardware, matrix[: order + 1].T, matrix[order + 1 :].T, np.float32
    )


def judge_recursion(hardware, b, a, kind):
    """Judge ``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``, coefficients (modes, ..)."""
    for own_b, own_a in zip(b, a, strict=True):
        bottom = [Fraction(1), *(-Fraction(float(v)) for v in own_a)]  # in powers of z^-1
        top = [Fraction(float(v)) for v in own_b]
        path = [Fraction(0), *(Fraction(c) for c in taps(hardware))]
        around = [Fraction(0)] * max(len(bottom), len(top) + len(path) - 1)
        for i, v in enumerate(bottom):
            around[i] += v
        for i, v in enumerate(top):
            for j, w in enumerate(path):
                around[i + j] += v * w
        if not is_schur(around):
            return False
    inputs, outputs = np.zeros(b.shape, dtype=kind), np.zeros(a.shape, dtype=kind)

    def run(y, last):
        inputs[:, 1:] = inputs[:, :-1].copy()
        inputs[:, 0] = y
        u = np.sum(b * inputs, axis=1, dtype=kind) + np.sum(a * outputs, axis=1, dtype=kind)
        outputs[:, 1:] = outputs[:, :-1].copy()
        outputs[:, :1] = u[:, None]
        return u.astype(float)

    return decays(hardware, run)


def is_schur(polynomial):
    """Whether all roots of exact coefficients, highest power first, lie inside the circle."""
    p = list(polynomial)
    while len(p) > 1:
        if p[-1] == 0:  # a root at zero
            p.pop()
            continue
        if not abs(p[-1]) < abs(p[0]):
            return False
        k = p[-1] / p[0]
        p = [v - k * w for v, w in zip(p[:-1], p[:0:-1], strict=True)]
    return True


def judge_pyrtc(files, design, options):
    """Close the loop around the matrices of the gain file, and run the predictor as pyRTC does."""
    predictor = YAML(typ="safe").load(files[0])["loop"]["predictor"]
    gain_file, delay = files[0].with_name(predictor["gain_file"]), predictor["delay_frames"]
    with fits.open(gain_file) as units:
        A, B, C, D = (units[name].data.astype(float) for name in "ABCD")

    def step(x, y, last):
        x = A @ x + B @ y
        return x, C @ x + D @ y

    running = GainFilePredictor(len(C), delay, gain_file=gain_file)
    sent = [np.zeros(len(C), dtype=np.float32)] * delay  # with pyRTC's sign

    def run(y, last):
        running.update(y.astype(np.float32) - sent[0])
        sent[:] = [*sent[1:], (-running.predict()).astype(np.float32)]
        return -sent[-1].astype(float)

    return bool(Loop(design.hardware, len(A), step).radius() < 1 and decays(design.hardware, run))


def judge_cacao(files, design, options):
    """Multiply the history of pseudo-open-loop values, whose mirror has cacao's sign."""
    matrix = fits.getdata(files[0]).astype(np.float32)
    m = len(matrix)
    history = np.zeros((matrix.shape[1] // m, m), dtype=np.float32)
    past = [np.zeros(m, dtype=np.float32) for _ in taps(design.hardware)]

    def run(y, last):
        correction = sum(
            np.float32(c) * v for c, v in zip(taps(design.hardware), past, strict=True)
        )
        history[1:] = history[:-1].copy()
        history[0] = y.astype(np.float32) - correction
        past[:] = [matrix @ history.ravel(), *past[:-1]]
        return -past[0].astype(float)

    return decays(design.hardware, run)


WITHOUT_ORACLE = set()  # targets that only the tests of their own folder judge
ORACLES = {
    "c": judge_c,
    "dao": judge_dao,
    "matlab": judge_matlab,
    "pyrtc": judge_pyrtc,
    "cacao": judge_cacao,
}


def judge(folder, seed):
    """Export one random gain file to each target; return the verdict of each, None if refused.

    A design that cannot be made has none.
    """
    rng = np.random.default_rng(seed)
    try:
        made = random_design(rng)
    except lbt.errors.LbtSynthError:
        return {}
    design = lbt.load_gain(lbt.save_gain(folder / "g.fits", made))
    verdicts = {}
    for name, oracle in ORACLES.items():
        options = random_options(name, rng)
        target = lbt.interop.target_named(name)
        try:
            written = lbt.interop.export(target.path_in(folder), design, name, **options)
        except (lbt.errors.NumericalError, lbt.errors.ProblemError):
            verdicts[name] = None
            continue
        verdicts[name] = oracle(written.files, design, options)
    return verdicts
