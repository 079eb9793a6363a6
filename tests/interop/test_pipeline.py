"""The targets of an export."""

import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from ruamel.yaml import YAML
from scipy.io import loadmat
from support.compiled import Compiled
from support.exports import relative
from support.recorded_runs import recorded_run
from support.refusals import require_refusals
from support.sensor_loops import SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters
from lbt_synth.interop.cacao.export import predictive_filter
from lbt_synth.interop.pipeline import rehearse, target_named, target_names
from lbt_synth.interop.pyrtc.plugin import GainFilePredictor
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop import Disturbance

pytestmark = pytest.mark.usefixtures("short_rehearsal")

# The exported files are judged by other code than proves them, and in the target's arithmetic.
FRAMES = 1000
SINGLE = {"single": np.float32, "double": np.float64}


def random_design(rng):
    """A quick design for any loop: rate, delay, axes, lines from 0.5 Hz up, damping from 1e-5."""
    rate, modes = float(10 ** rng.uniform(2, 3.5)), int(rng.integers(1, 3))
    delay = float(rng.choice([1, 2, 3, rng.uniform(1, 4)], p=[0.15, 0.45, 0.15, 0.25]))
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=delay, modes=modes)
    kind = rng.choice(["kalman", "hinf", "law"], p=[0.6, 0.25, 0.15])
    if kind == "law":
        leak = float(rng.choice([1.0, rng.uniform(0.9, 1)]))
        law = lbt.design.IntegratorLaw(modulus_margin=float(rng.uniform(0.2, 0.8)), leak=leak)
        return lbt.integrator(path, law=law)
    noise = float(10 ** rng.uniform(-1, 2.5))
    slow = turbulence(rng, rate)
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
        vibrations=lines,
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


def decays(hardware, step):
    """Whether a loop in any arithmetic comes back from a kick: ``step(y, last) -> u``.

    A slow line may still swing up when the first frames are over.
    """
    past, residual = [np.zeros(hardware.modes)] * len(taps(hardware)), np.full(hardware.modes, 100)
    sizes = []
    for frames in (FRAMES, 16 * FRAMES):
        while len(sizes) < frames:
            past = [step(residual, past[0]), *past[:-1]]
            residual = -sum(c * v for c, v in zip(taps(hardware), past, strict=True))
            sizes.append(np.max(np.abs(residual)))
            if not sizes[-1] < 1e30:
                return False
        late = np.max(sizes[-frames // 4 :])
        if late <= 1.001 * np.max(sizes[: -frames // 4]):
            return True
    return False


def run_c(files, hardware, options):
    """Run the compiled source."""
    theirs = Compiled(files[0], single=options.get("precision") == "single")
    given = options.get("form") == "estimator"
    return lambda y, last: theirs.step(y, last) if given else theirs.step(y)


def run_matlab(files, hardware, options):
    """Step ``ss(A, B, C, D)`` as MATLAB does."""
    form = loadmat(files[0])["textbook"][0, 0]
    A, B, C, D = (form[name] for name in "ABCD")
    state = [np.zeros(len(A))]

    def run(y, last):
        u = C @ state[0] + D @ y
        state[0] = A @ state[0] + B @ y
        return u

    return run


def run_dao(files, hardware, options):
    """Take the rows of the matrix: ``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``."""
    b, a = np.split(np.load(files[0]), [len(np.load(files[0])) // 2 + 1])
    inputs, outputs = np.zeros_like(b), np.zeros_like(a)

    def run(y, last):
        inputs[1:] = inputs[:-1].copy()
        inputs[0] = y
        u = np.sum(b * inputs, axis=0) + np.sum(a * outputs, axis=0)
        outputs[1:] = outputs[:-1].copy()
        outputs[:1] = u
        return u.astype(float)

    return run


def run_pyrtc(files, hardware, options):
    """Run the predictor as pyRTC does."""
    conf = YAML(typ="safe").load(files[0])["loop"]["predictor"]
    delay, gain_file = conf["delay_frames"], files[0].with_name(conf["gain_file"])
    running = GainFilePredictor(hardware.modes, delay, gain_file=gain_file)
    sent = [np.zeros(hardware.modes, dtype=np.float32)] * delay  # with pyRTC's sign

    def run(y, last):
        running.update(y.astype(np.float32) - sent[0])
        sent[:] = [*sent[1:], (-running.predict()).astype(np.float32)]
        return -sent[-1].astype(float)

    return run


def run_cacao(files, hardware, options):
    """Multiply the history of pseudo-open-loop values, whose mirror has cacao's sign."""
    matrix = fits.getdata(files[0]).astype(np.float32)
    history = np.zeros((matrix.shape[1] // len(matrix), len(matrix)), dtype=np.float32)
    past = [np.zeros(len(matrix), dtype=np.float32) for _ in taps(hardware)]

    def run(y, last):
        correction = sum(np.float32(c) * v for c, v in zip(taps(hardware), past, strict=True))
        history[1:] = history[:-1].copy()
        history[0] = y.astype(np.float32) - correction
        past[:] = [matrix @ history.ravel(), *past[:-1]]
        return -past[0].astype(float)

    return run


ORACLES = {
    "c": run_c,
    "cacao": run_cacao,
    "dao": run_dao,
    "matlab": run_matlab,
    "pyrtc": run_pyrtc,
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
        target = target_named(name)
        try:
            written = lbt.interop.export(target.path_in(folder), design, name, **options)
        except (lbt.errors.NumericalError, lbt.errors.ProblemError):
            verdicts[name] = None
            continue
        step = oracle(written.files, design.hardware, options)
        verdicts[name] = decays(design.hardware, step)
    return verdicts


CHUNK = 100


FILES = {"k.c": "c", "k.mat": "matlab", "k.npy": "dao"}
PATH = lbt.LoopHardware(frame_rate_hz=800)
PHASE = 100 * np.cumsum(np.random.default_rng(0).standard_normal((1500, 2)), axis=0) / 30


def test_the_oracles_see_a_loop_that_is_unstable(tmp_path):
    """Files of an integrator, judged in the loop of one that is too slow for it."""
    assert list(ORACLES) == list(target_names())
    quick, late = (
        lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=delay) for delay in (2, 3)
    )
    design = lbt.integrator(quick, gain=0.9)
    for name, oracle in ORACLES.items():
        target = target_named(name)
        files = lbt.interop.export(target.path_in(tmp_path), design, name).files
        assert decays(quick, oracle(files, quick, {}))
        if name != "cacao":  # its configuration has the delay, so that this loop has none to miss
            assert not decays(late, oracle(files, late, {}))


def written_stable(folder, seeds):
    """Require that no file of these gain files is unstable; return how many were written."""
    written = dict.fromkeys(ORACLES, 0)
    for seed in seeds:
        for name, verdict in judge(folder, seed).items():
            assert verdict is not False, (name, seed)
            written[name] += verdict is not None
    return written


def test_no_target_writes_an_unstable_file(tmp_path):
    assert all(written_stable(tmp_path, [6]).values())


@pytest.mark.study
@pytest.mark.parametrize("chunk", range(100))
def test_no_target_writes_one_of_ten_thousand(tmp_path, chunk):
    seeds = range(CHUNK * chunk, CHUNK * (chunk + 1))
    assert all(written_stable(tmp_path, seeds).values())


def test_what_is_no_export_is_refused(tmp_path, designs, slow):
    """Whatever the target, an option of another one, and what makes no matrix or no rehearsal."""
    failed = lbt.design.Check(name="rms", value=2.0, limit=1.0, computed_by="guess")
    certificate = lbt.design.Certificate(checks=(failed,), gamma=np.nan, rms_per_output=np.zeros(0))
    bad = replace(slow, certificate=certificate)

    def write(file, design=slow, target=None, **options):
        target = target or FILES.get(file, "dao")
        return lambda: lbt.interop.export(tmp_path / file, design, target, **options)

    problem, output = lbt.errors.ProblemError, lbt.errors.OutputError
    rows = [
        row
        for file in FILES
        for row in (
            (write(file, 3), problem, "expected a Design; got int"),
            (write(file, bad), lbt.errors.CertificateError, "this one failed: rms"),
            (write(f"nowhere/{file}", target=FILES[file]), output, "cannot write"),
            (write(f"{file}x", target=FILES[file]), output, "must end in"),
        )
    ]
    digit = "64 hexadecimal digits"
    rows += [
        (write("k.c", gain_digest=sha), problem, digit) for sha in ("AB" * 32, "ab" * 32 + "\n")
    ]
    for target, option in (("dao", "form"), ("matlab", "modes"), ("c", "steps")):
        words = f"{option} is no option of target"
        rows.append((write("k", target=target, **{option: 3}), problem, words))
    wild = MixedController(filter=designs["kalman"], gains=[0.0, 0.0, 1.5])
    bare = MixedController(filter=designs["kalman"].controller, gains=[0.0, 0.0, 0.5])
    alone, any_error = MixedController(gains=[0.5]), lbt.errors.LbtSynthError
    rows += [
        (write("k", target="fpga"), problem, "target must be one of c, cacao"),
        (write("k.npy", MixedController(gains=[0.5, 0.3])), any_error, "got NoneType"),
        (write("k.npy", wild), any_error, "gain|stable"),
        (write("k.npy", bare), any_error, "must be a certified design"),
        (write("k.npy", other_gain=0.3), any_error, "other_gain needs modes, the number"),
        (write("k.npy", other_gain=-0.3, modes=3), any_error, "above 0"),
        (write("k.npy", alone, other_gain=0.3), any_error, "other_gain goes with a design"),
    ]
    require_refusals(rows)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", target_names())
def test_the_same_design_gives_the_same_files_and_a_certificate_of_them(tmp_path, designs, name):
    own, seen = target_named(name), []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        written = lbt.interop.export(
            own.path_in(folder), designs["hinf"], name, gain_digest="ab" * 32
        )
        *files, certificate = written.files
        seen.append([path.read_bytes() for path in files])
        beside = json.loads(certificate.read_text())
        assert (beside["target"], beside["gain_sha256"]) == (name, "ab" * 32)
        digests = {beside["file"]: beside["file_sha256"], **beside.get("others_sha256", {})}
        found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
        assert digests == found
        assert [check["name"] for check in beside["checks"]] == [c.name for c in written.checks]
        assert all(check["passed"] for check in beside["checks"])
        assert beside["precision"] == own.precision
        assert 0 <= written.error < 1e-3
    assert seen[0] == seen[1]


@pytest.mark.parametrize("name", target_names())
def test_a_sensor_gain_of_each_axis_is_in_the_numbers(tmp_path, designs, name):
    """A record's design knows the gains of its sensor; what runs at those is the design."""
    own, gains = designs["kalman"].problem, (0.6, 0.8)
    hardware = replace(own.hardware, sensor_matrix=np.diag(gains))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=own.hardware.frame_rate_hz,
        turbulence=own.turbulence,
        vibrations=own.vibrations,
        noise_nm=15.0,
        sensor_matrix=np.diag(gains),
    )
    phase = 100 * np.cumsum(np.random.default_rng(0).standard_normal((600, 2)), axis=0) / 30
    for design in (lbt.kalman(plant), lbt.integrator(hardware, gain=0.5)):
        target = target_named(name)
        written = lbt.interop.export(target.path_in(tmp_path), design, name)
        assert all(check.passed for check in written.checks)
        runs = [
            recorded_run(run, hardware, phase[None], np.zeros((1, 600, 2)))[0, :, :2]
            for run in (written.start(np.inf), design.controller.start())
        ]
        assert np.std(runs[0] - runs[1]) < 1e-2 * np.std(runs[1])


@pytest.mark.parametrize("name", target_names())
def test_what_is_proved_is_what_was_read_from_the_file(tmp_path, designs, monkeypatch, name):
    """Each file holds numbers; where one is another when it is read, it is not written."""
    own = target_named(name)

    def damaged(files, like):
        return louder(own.read(files, like))

    monkeypatch.setattr(f"lbt_synth.interop.{name}.export.TARGET", replace(own, read=damaged))
    with pytest.raises(lbt.errors.NumericalError, match="must hold the numbers that are proved"):
        lbt.interop.export(own.path_in(tmp_path), designs["integrator"], name)
    assert not list(tmp_path.iterdir())


def louder(numbers):
    """The numbers of a target, with a gain of 1.2 on what acts on measurements."""
    if isinstance(numbers, np.ndarray):  # dao
        return 1.2 * numbers * (np.arange(len(numbers)) <= len(numbers) // 2)[:, None] + (
            numbers * (np.arange(len(numbers)) > len(numbers) // 2)[:, None]
        )
    if isinstance(numbers, tuple) and isinstance(numbers[0], np.ndarray):  # cacao
        return 1.2 * numbers[0], numbers[1]
    if hasattr(numbers, "response"):  # pyrtc
        return replace(numbers, response=numbers.response / 1.2)
    if hasattr(numbers, "gains"):  # c
        return replace(numbers, gains={some: 1.2 * K for some, K in numbers.gains.items()})
    return replace(numbers, B=1.2 * numbers.B, D=1.2 * numbers.D)


@pytest.fixture(scope="module")
def slow():
    return lbt.integrator(PATH, gain=0.4)


@pytest.mark.parametrize("name", target_names())
def test_each_target_runs_beside_the_design(slow, name):
    noise = np.random.default_rng(1).standard_normal((1500, 2))
    series = Disturbance(phase_nm=PHASE, noise=noise, sensor_gain=0.8)
    run = rehearse(slow, name, series, hardware=PATH)
    loop = lbt.close_loop(PATH, slow, sensor_gain=0.8)
    exact = filter_series(loop.system, np.hstack([PHASE, noise]))[run.settle_frames :]
    assert np.allclose(run.design.residual_nm[0], exact[:, :2], atol=1e-9)
    assert np.allclose(run.design.commands[0], exact[:, 2:4], atol=1e-9)
    assert run.checks[0].name.startswith("spectral radius at sensor gains")
    assert all(check.passed for check in run.checks)
    single = name in ("cacao", "dao", "pyrtc")
    largest = np.max(np.abs(run.differences))
    assert (largest > 1e-9) == single
    assert largest < (0.01 if name != "cacao" else 1.0) * np.max(np.abs(PHASE))
    assert run.clipped_frames(run.target) == run.clipped_frames(run.design) == 0


@pytest.mark.parametrize("name", ["cacao", "dao", "pyrtc"])
def test_a_target_that_knows_its_limit_comes_back(slow, name):
    """After a step beyond the stroke, the residual is what it was before."""
    phase = np.zeros((1200, 2))
    phase[300:600] = 100.0
    run = rehearse(slow, name, Disturbance(phase_nm=phase), hardware=PATH, stroke=50.0)
    start = run.settle_frames
    assert np.max(np.abs(run.target.commands)) == 50
    assert 0 < run.clipped_frames(run.target) <= 300
    assert run.clipped_frames(run.design) > 500  # the plain form winds up
    back = run.target.residual_nm[0, 600 - start :]
    assert np.max(np.abs(back[40:])) < 0.5


@pytest.fixture(scope="module")
def quick():
    """A design whose filter is short."""
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    line = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(1.0,))
    models = {"turbulence": air, "vibrations": [line], "noise_nm": 15.0}
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, modes=1, **models)
    return lbt.hinf(plant, gamma_ratio=1.1, route="riccati")


@pytest.mark.parametrize("name", target_names())
def test_what_runs_is_what_is_exported(tmp_path, quick, name):
    target, total = target_named(name), PHASE[:600, :1]
    written = lbt.interop.export(target.path_in(tmp_path), quick, name)
    rest = np.zeros(total.shape)
    alone = recorded_run(written.start(60.0), quick.hardware, total, rest, stroke=60.0)[0]
    series = Disturbance(phase_nm=total)
    run = rehearse(quick, name, series, hardware=quick.hardware, stroke=60.0)
    assert np.array_equal(run.target.commands[0], alone[run.settle_frames :, 1:2])
    assert [check.value for check in run.checks] == [check.value for check in written.checks]
    if name == "cacao":
        steps = json.loads(written.files[1].read_text())["steps"]
        assert steps == predictive_filter(quick).fewest_steps(0.01)


def test_a_loop_that_the_target_makes_unstable_is_named(tmp_path, slow, monkeypatch):
    wrong = lbt.Controller(
        A=np.eye(2), B=-0.4 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=PATH.dt_s
    )
    found = lbt.interop.export(tmp_path / "k.c", slow, "c")
    broken = replace(found, start=lambda _: wrong.start())
    monkeypatch.setattr("lbt_synth.interop.pipeline.export", lambda *_: broken)
    with pytest.raises(lbt.errors.NumericalError, match="of c the loop grows beyond all numbers"):
        rehearse(slow, "c", Disturbance(phase_nm=np.vstack([PHASE] * 3)), hardware=PATH)


def test_what_cannot_be_rehearsed_is_refused(slow):
    several = lbt.kalman(example_plant((SLOW,)))
    series, strong = (Disturbance(phase_nm=PHASE, sensor_gain=gain) for gain in (1.0, 4.0))

    def run(*given):
        return lambda: rehearse(*given, hardware=PATH)

    words = "got one of several sensors"
    require_refusals(
        [
            (run(slow, "dao", strong), lbt.errors.UnstableLoopError, None),
            (run(several, "c", series), lbt.errors.ProblemError, words),
        ]
    )


AIR = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=20.0, frame_rate_hz=800)


def response(column, z):
    order = len(column) // 2
    powers = z[:, None] ** -np.arange(order + 1)
    return (powers @ column[: order + 1]) / (1 - powers[:, 1:] @ column[order + 1 :])


def steps(control, columns, frames=40):
    """Commands of a controller and of the matrix, run beside each other on white measurements."""
    rng = np.random.default_rng(0)
    twin = lbt.interop.dao.export.InnerLoop(columns)
    series = rng.standard_normal((frames, columns.shape[1]))
    return np.array([control.step(y) for y in series]), np.array([twin.step(y) for y in series])


def test_a_design_and_integrators_make_one_matrix(tmp_path, designs):
    gains = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]
    control = MixedController(filter=designs["integrator"], gains=gains, leak=0.99)
    written = lbt.interop.export(tmp_path / "k.npy", control, "dao", order=4)
    matrix = np.load(written.files[0])
    assert matrix.shape == (9, 6)
    own, found = steps(control, matrix)
    assert relative(found, own) < 1e-5
    assert not matrix[:, 4].any()  # no gain, no command
    names = [check.name for check in written.checks]
    assert any("spectral radius" in name and name.endswith("(modes 2 and 5)") for name in names)
    beside = json.loads((tmp_path / "k.npy.certificate.json").read_text())
    assert [check["name"] for check in beside["checks"]] == names


def test_filters_of_all_modes_make_one_matrix(tmp_path):
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=50, direction=(1.0,))
    models = {"noise_nm": [5.0, 6.0, 7.0], "vibrations": {1: [line]}, "sensor_gain": 0.8}
    filters = modal_filters([AIR] * 3, hardware=lbt.LoopHardware(frame_rate_hz=800), **models)
    matrix = np.load(lbt.interop.export(tmp_path / "k.npy", filters, "dao").files[0])
    z = np.exp(2j * np.pi * np.linspace(0.01, 0.49, 20))
    for mode in range(3):
        system = filters.design(mode).controller.to_statespace()
        expected = system.frequency_response(np.angle(z) / (2 * np.pi) * 800)[:, 0, 0]
        assert relative(response(matrix[:, mode].astype(float), z), expected) < 1e-4
    mixed = MixedController(filter=filters, gains=[0.4] * 5, filtered=[1, 2, 4])
    both = np.load(lbt.interop.export(tmp_path / "both.npy", mixed, "dao").files[0])
    assert np.array_equal(both[:, [1, 2, 4]], matrix)
    assert both[[0, 21]][:, [0, 3]].tolist() == np.float32([[0.4, 0.4], [1, 1]]).tolist()


def test_an_integrator_for_each_further_mode(tmp_path, designs):
    target = tmp_path / "k.npy"
    lbt.interop.export(target, designs["kalman"], "dao", modes=4, other_gain=0.25)
    matrix = np.load(target)
    plain = np.load(lbt.interop.export(target, designs["kalman"], "dao", modes=2).files[0])
    assert np.array_equal(matrix[:, :2], plain)
    assert matrix[:, 2].tolist() == [0.25, *[0.0] * 20, 1.0, *[0.0] * 19]


GAINS = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]


def loop_commands(run, hardware, seed=4, frames=600):
    """Commands of six modes in a loop, on noise and a slow phase."""
    rng = np.random.default_rng(seed)
    path = lbt.LoopHardware(frame_rate_hz=hardware.frame_rate_hz, modes=6)
    total = np.cumsum(rng.standard_normal((1, frames, 6)), axis=1)
    noise = 0.1 * rng.standard_normal((1, frames, 6))
    return recorded_run(run, path, total, noise)[0, :, 6:12]


def test_cacao_holds_all_modes_in_one_matrix(tmp_path, designs):
    control = MixedController(filter=designs["hinf"], gains=GAINS)
    written = lbt.interop.export(tmp_path / "pf.fits", control, "cacao")
    matrix = fits.getdata(written.files[0])
    steps = matrix.shape[1] // 6
    assert matrix.shape == (6, 6 * steps)
    cube = matrix.reshape(6, steps, 6)
    assert not cube[4].any()  # no gain, no command
    assert np.array_equal(cube[2, :, 2], cube[5, :, 5])
    for i, j in ((0, 2), (2, 0), (2, 3), (5, 2)):
        assert not cube[i, :, j].any()
    alone = lbt.interop.export(tmp_path / "own.fits", designs["hinf"], "cacao", steps=steps)
    assert np.array_equal(fits.getdata(alone.files[0]).reshape(2, steps, 2), cube[:2, :, :2])
    own = loop_commands(control, designs["hinf"].hardware)
    assert relative(loop_commands(written.start(np.inf), designs["hinf"].hardware), own) < 1e-3
    names = [check.name for check in written.checks]
    assert sum("small gain" in name and "(modes 2 and 5)" in name for name in names) == 1
    assert sum("residual at sensor gain 1," in name for name in names) == 3


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("form", ["plain", "estimator"])
def test_c_source_holds_all_modes(tmp_path, designs, form, precision):
    """Compiled, in a loop; in estimator form the commands that it gave were applied."""
    control = MixedController(filter=designs["kalman"], gains=GAINS, leak=0.99)
    options = {"form": form, "precision": precision, "modes": 6}
    written = lbt.interop.export(tmp_path / "ctl.c", control, "c", **options)
    theirs = Compiled(written.files[0], single=precision == "single")
    hardware = designs["kalman"].hardware
    own = loop_commands(control, hardware)
    limit = {"double": 1e-12, "single": 1e-4}[precision]
    if form == "plain":
        assert relative(loop_commands(theirs, hardware), own) < limit
    assert relative(loop_commands(written.start(np.inf), hardware), own) < limit
    last = np.zeros(6)
    theirs.reset()
    twin = written.start(np.inf)
    for y in np.random.default_rng(5).standard_normal((50, 6)):
        last = theirs.step(y, last) if form == "estimator" else theirs.step(y)
        assert np.array_equal(last, twin.step(y))
    assert not last[4]
    names = [check.name for check in written.checks]
    assert sum("spectral radius at" in name for name in names) == 3


def test_the_source_of_many_modes_proves_equal_ones_once(tmp_path, designs):
    options = {"modes": 120, "other_gain": 0.4, "form": "estimator"}
    written = lbt.interop.export(tmp_path / "ctl.c", designs["kalman"], "c", **options)
    names = [check.name for check in written.checks if "spectral radius at" in check.name]
    assert len(names) == 2
    theirs = Compiled(written.files[0], single=False)
    assert np.allclose(theirs.step(np.ones(120), np.ones(120))[2:], 1.4)


def test_pyrtc_gets_the_gain_of_all_others_and_its_proof(tmp_path, designs):
    options = {"modes": 5, "other_gain": 0.4}
    written = lbt.interop.export(tmp_path / "k", designs["hinf"], "pyrtc", **options)
    text = written.files[0].read_text()
    assert "other_gain: 0.4 " in text
    assert "num_modes: 5" in text
    names = [check.name for check in written.checks]
    assert any("spectral radius" in name and name.endswith("(modes 2, 3 and 4)") for name in names)
    with pytest.raises(lbt.errors.LbtSynthError, match="closed loop|stable"):
        lbt.interop.export(tmp_path / "no", designs["hinf"], "pyrtc", modes=9, other_gain=1.4)
    control = MixedController(filter=designs["hinf"], gains=GAINS)
    with pytest.raises(lbt.errors.ProblemError, match="one design, for the first modes"):
        lbt.interop.export(tmp_path / "no", control, "pyrtc")
    assert not (tmp_path / "no").exists()
