"""The targets of an export."""

import hashlib
import json
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from ruamel.yaml import YAML
from scipy.io import loadmat
from support.compiled import Compiled
from support.exports import CacaoProgram, DifferenceEquation, relative
from support.lqg import slow_plant
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
CHUNK = 100  # of the ten thousand gain files


def random_design(rng):
    """A quick design for any loop: rate, delay, axes, lines from 0.5 Hz up, damping from 1e-5."""
    rate, modes = float(10 ** rng.uniform(2, 3.5)), int(rng.integers(1, 3))
    delay = float(rng.choice([1, 2, 3, rng.uniform(1, 4)], p=[0.15, 0.45, 0.15, 0.25]))
    path = {"frame_rate_hz": rate, "delay_frames": delay, "modes": modes}
    kind = rng.choice(["kalman", "hinf", "law"], p=[0.6, 0.25, 0.15])
    if kind == "law":
        leak = float(rng.choice([1.0, rng.uniform(0.9, 1)]))
        law = lbt.design.IntegratorLaw(modulus_margin=float(rng.uniform(0.2, 0.8)), leak=leak)
        return lbt.integrator(lbt.LoopHardware(**path), law=law)
    noise = float(10 ** rng.uniform(-1, 2.5))
    pole = 1 - 10 ** rng.uniform(-4, -1)
    coefficients = [pole]
    if rng.random() >= 0.5:
        angle = 2 * np.pi * 10 ** rng.uniform(-1, 1) / rate
        coefficients = [2 * pole * np.cos(angle), -(pole**2)]
    air = lbt.models.ARModel(
        coefficients=coefficients, driving_rms_nm=10 ** rng.uniform(0, 2), frame_rate_hz=rate
    )
    lines = [
        lbt.Vibration(
            frequency_hz=float(np.exp(rng.uniform(np.log(0.5), np.log(0.45 * rate)))),
            damping=float(10 ** rng.uniform(-5, -1)),
            rms_nm=float(10 ** rng.uniform(0, 3)),
            direction=tuple(np.eye(modes)[rng.integers(modes)]),
        )
        for _ in range(rng.integers(0, 5))
    ]
    plant = lbt.tip_tilt_plant(turbulence=air, noise_nm=noise, vibrations=lines, **path)
    if kind == "hinf":
        return lbt.hinf(plant, gamma_ratio=float(rng.uniform(1.02, 3)), route="riccati")
    return lbt.kalman(plant)


def random_options(name, rng):
    """Options of an export that change what is written."""
    if name == "c":
        kinds = {"form": ["plain", "estimator"], "precision": ["single", "double"]}
        return {option: str(rng.choice(words)) for option, words in kinds.items()}
    if name == "cacao" and rng.random() >= 0.7:
        return {"steps": int(rng.integers(8, 400))}
    return {}


def taps(hardware):
    """Weights of u(k), u(k-1), .. in the correction of frame k, for a mirror that settles."""
    whole = math.floor(hardware.delay_frames - 1)
    part = hardware.delay_frames - 1 - whole
    return [0.0] * whole + [1 - part, part]


def decays(hardware, program):
    """Whether a loop in any arithmetic comes back from a kick; slow lines may swing up at first."""
    past, residual = [np.zeros(hardware.modes)] * len(taps(hardware)), np.full(hardware.modes, 100)
    sizes = []
    for frames in (FRAMES, 16 * FRAMES):
        while len(sizes) < frames:
            past = [program.step(residual), *past[:-1]]
            residual = -sum(c * v for c, v in zip(taps(hardware), past, strict=True))
            sizes.append(np.max(np.abs(residual)))
            if not sizes[-1] < 1e30:
                return False
        late = np.max(sizes[-frames // 4 :])
        if late <= 1.001 * np.max(sizes[: -frames // 4]):
            return True
    return False


def run_matlab(files, *_):
    """Step ``ss(A, B, C, D)`` as MATLAB does."""
    form = loadmat(files[0])["textbook"][0, 0]
    A, B, C, D = (form[name] for name in "ABCD")
    state = np.zeros(len(A))

    def step(y):
        u = C @ state + D @ y
        state[:] = A @ state + B @ y
        return u

    return SimpleNamespace(step=step, reset=lambda: None)


def run_pyrtc(files, hardware, _):
    """Run the predictor as pyRTC does."""
    conf = YAML(typ="safe").load(files[0])["loop"]["predictor"]
    delay, gain_file = conf["delay_frames"], files[0].with_name(conf["gain_file"])
    others = {"gain_file": gain_file, "other_gain": conf["other_gain"]}
    predictor = GainFilePredictor(hardware.modes, delay, **others)
    sent = [np.zeros(hardware.modes, dtype=np.float32)] * delay  # with pyRTC's sign

    def step(y):
        predictor.update(y.astype(np.float32) - sent[0])
        sent[:] = [*sent[1:], (-predictor.predict()).astype(np.float32)]
        return -sent[-1].astype(float)

    return SimpleNamespace(step=step, reset=lambda: None)


ORACLES = {
    "c": lambda files, _, options: Compiled(files[0], single=options.get("precision") == "single"),
    "cacao": lambda files, path, _: CacaoProgram(fits.getdata(files[0]), path.delay_frames + 1),
    "dao": lambda files, *_: DifferenceEquation(np.load(files[0])),
    "matlab": run_matlab,
    "pyrtc": run_pyrtc,
}
FILES = {"k.c": "c", "k.mat": "matlab", "k.npy": "dao"}
PATH = lbt.LoopHardware(frame_rate_hz=800)
PHASE = 100 * np.cumsum(np.random.default_rng(0).standard_normal((1500, 2)), axis=0) / 30
PHASE[:5] = 0  # until pyRTC's loop runs


def test_the_oracles_see_a_loop_that_is_unstable(tmp_path):
    """Files of an integrator, judged in the loop of one that is too slow for it."""
    assert list(ORACLES) == list(target_names())
    quick = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    late = replace(quick, delay_frames=3)
    design = lbt.integrator(quick, gain=0.9)
    for name, oracle in ORACLES.items():
        target = target_named(name)
        files = lbt.interop.export(target.path_in(tmp_path), design, name).files
        assert decays(quick, oracle(files, quick, {}))
        if name != "cacao":  # its configuration has the delay, so that this loop has none to miss
            assert not decays(late, oracle(files, late, {}))


def written_stable(folder, seeds):
    """Require that no file of random gain files is unstable; return how many each target took."""
    written = dict.fromkeys(ORACLES, 0)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        try:
            made = random_design(rng)
        except lbt.errors.LbtSynthError:
            continue
        design = lbt.load_gain(lbt.save_gain(folder / "g.fits", made))
        for name, oracle in ORACLES.items():
            options, place = random_options(name, rng), target_named(name).path_in(folder)
            try:
                files = lbt.interop.export(place, design, name, **options).files
            except (lbt.errors.NumericalError, lbt.errors.ProblemError):
                continue
            program = oracle(files, design.hardware, options)
            assert decays(design.hardware, program), (name, seed)
            written[name] += 1
    return written


def test_no_target_writes_an_unstable_file(tmp_path):
    assert all(written_stable(tmp_path, [6]).values())


@pytest.mark.study
@pytest.mark.parametrize("chunk", range(10_000 // CHUNK))
def test_no_target_writes_one_of_ten_thousand(tmp_path, chunk):
    seeds = range(CHUNK * chunk, CHUNK * (chunk + 1))
    assert all(written_stable(tmp_path, seeds).values())


def test_what_is_no_export_is_refused(tmp_path, designs, slow, sensors_design):
    """Whatever the target, an option of another one, and what makes no matrix or no rehearsal."""
    failed = lbt.design.Check(name="rms", value=2.0, limit=1.0, computed_by="guess")
    certificate = lbt.design.Certificate(checks=(failed,), gamma=np.nan, rms_per_output=np.zeros(0))
    bad = replace(slow, certificate=certificate)
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))

    def write(file, design=slow, target=None, **options):
        target = target or FILES.get(file, "dao")
        return lambda: lbt.interop.export(tmp_path / file, design, target, **options)

    problem, output = lbt.errors.ProblemError, lbt.errors.OutputError
    rows = []
    for file, target in FILES.items():
        rows += [
            (write(file, 3), problem, "expected a Design; got int"),
            (write(file, bad), lbt.errors.CertificateError, "this one failed: rms"),
            (write(f"nowhere/{file}", target=target), output, "cannot write"),
            (write(f"{file}x", target=target), output, "must end in"),
        ]
    rows += [
        (write("k.c", gain_digest=digest), problem, "64 hexadecimal digits")
        for digest in ("AB" * 32, "ab" * 32 + "\n")
    ]
    others = sorted({*target_names()} - {"c"})
    kinds = [(sensors_design, "this design reads slow, m1, m2 beside", name) for name in others]
    kinds += [(bare, "needs the design of a loop", name) for name in ("cacao", "dao", "pyrtc")]
    rows += [
        (write(target_named(name).path_in(tmp_path), design, name), problem, words)
        for design, words, name in kinds
    ]
    rows += [
        (write("k", target=target, **{option: 3}), problem, f"{option} is no option of target")
        for target, option in (("dao", "form"), ("matlab", "modes"), ("c", "steps"))
    ]
    mixed = MixedController(filter=slow, gains=GAINS)
    wild = MixedController(filter=designs["kalman"], gains=[0.0, 0.0, 1.5])
    unsure = MixedController(filter=designs["kalman"].controller, gains=[0.0, 0.0, 0.5])
    alone, any_error = MixedController(gains=[0.5]), lbt.errors.LbtSynthError
    rows += [
        (write("k", target="fpga"), problem, "target must be one of c, cacao"),
        (write("k.npy", MixedController(gains=[0.5, 0.3])), any_error, "got NoneType"),
        (write("k.npy", wild), any_error, "gain|stable"),
        (write("k.npy", unsure), any_error, "must be a certified design"),
        (write("k.npy", other_gain=0.3), any_error, "other_gain needs modes, the number"),
        (write("k.npy", other_gain=-0.3, modes=3), any_error, "above 0"),
        (write("k.npy", alone, other_gain=0.3), any_error, "other_gain goes with a design"),
        (write("k", target="pyrtc", modes=9, other_gain=1.4), any_error, "closed loop|stable"),
        (write("k", mixed, "pyrtc"), problem, "one design, for the first modes"),
    ]
    require_refusals(rows)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", target_names())
def test_the_same_design_gives_the_same_files_and_a_certificate_of_them(tmp_path, designs, name):
    target, digest, contents = target_named(name), "ab" * 32, []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        place = target.path_in(folder)
        written = lbt.interop.export(place, designs["hinf"], name, gain_digest=digest)
        *files, certificate = written.files
        contents.append({path.name: path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    beside = json.loads(certificate.read_text())
    facts = {"target": name, "gain_sha256": digest, "precision": target.precision}
    assert beside.items() >= facts.items()
    digests = {beside["file"]: beside["file_sha256"], **beside.get("others_sha256", {})}
    assert digests == {file: hashlib.sha256(c).hexdigest() for file, c in contents[1].items()}
    assert [check["name"] for check in beside["checks"]] == [c.name for c in written.checks]
    assert all(check["passed"] for check in beside["checks"])
    assert 0 <= written.error < 1e-3


@pytest.mark.parametrize("name", target_names())
def test_a_sensor_gain_of_each_axis_is_in_the_numbers(tmp_path, name):
    """A record's design knows the gains of its sensor; what runs at those is the design."""
    plant = slow_plant(modes=2, sensor_matrix=np.diag([0.6, 0.8]))
    path, phase = plant.hardware, PHASE[:600]
    for design in (lbt.kalman(plant), lbt.integrator(path, gain=0.5)):
        written = lbt.interop.export(target_named(name).path_in(tmp_path), design, name)
        assert all(check.passed for check in written.checks)
        residual, expected = (
            recorded_run(run, path, phase, 0 * phase)[0, :, :2]
            for run in (written.start(np.inf), design.controller.start())
        )
        assert np.std(residual - expected) < 1e-2 * np.std(expected)


LOUDER = {  # other numbers of each target
    "c": lambda terms: replace(terms, command=1.2 * terms.command),
    "cacao": lambda numbers: (1.2 * numbers[0], *numbers[1:]),
    "dao": lambda rows: 1.2 * rows,
    "matlab": lambda terms: replace(terms, command=1.2 * terms.command),
    "pyrtc": lambda filters: replace(filters, response=filters.response / 1.2),
}


@pytest.mark.parametrize("name", target_names())
def test_what_is_proved_is_what_was_read_from_the_file(tmp_path, designs, monkeypatch, name):
    """Each file holds numbers; where one is another when it is read, it is not written."""
    target = target_named(name)
    damaged = replace(target, read=lambda files, like: LOUDER[name](target.read(files, like)))
    monkeypatch.setattr(f"lbt_synth.interop.{name}.export.TARGET", damaged)
    with pytest.raises(lbt.errors.NumericalError, match="must hold the numbers that are proved"):
        lbt.interop.export(target.path_in(tmp_path), designs["integrator"], name)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def slow():
    return lbt.integrator(PATH, gain=0.4)


@pytest.mark.parametrize("name", target_names())
def test_each_target_runs_beside_the_design(tmp_path, slow, name):
    """What runs is what is exported."""
    written = lbt.interop.export(target_named(name).path_in(tmp_path), slow, name)
    noise = np.random.default_rng(1).standard_normal((1500, 2)) * (PHASE != 0)
    series = Disturbance(phase_nm=PHASE, noise=noise, sensor_gain=0.8)
    run = rehearse(slow, name, series, hardware=PATH)
    programs = written.start(np.inf), ORACLES[name](written.files, PATH, {})
    alone, program = (
        recorded_run(one, PATH, PHASE, noise, sensor_gain=0.8)[0, run.settle_frames :, 2:4]
        for one in programs
    )
    assert np.array_equal(run.target.commands[0], alone)
    assert relative(program, alone) < 1e-12
    assert [check.value for check in run.checks] == [check.value for check in written.checks]
    if name == "cacao":
        steps = json.loads(written.files[1].read_text())["steps"]
        assert steps == predictive_filter(slow).fewest_steps(0.01)
    loop = lbt.close_loop(PATH, slow, sensor_gain=0.8)
    exact = filter_series(loop.system, np.hstack([PHASE, noise]))[run.settle_frames :]
    assert np.allclose(run.design.residual_nm[0], exact[:, :2], atol=1e-9)
    assert np.allclose(run.design.commands[0], exact[:, 2:4], atol=1e-9)
    assert run.checks[0].name.startswith("spectral radius at sensor gains")
    assert all(check.passed for check in run.checks)
    largest = np.max(np.abs(run.differences))
    assert (largest > 1e-9) == (name in ("cacao", "dao", "pyrtc"))  # in single precision
    assert largest < (0.01 if name != "cacao" else 1.0) * np.max(np.abs(PHASE))
    assert run.clipped_frames(run.target) == run.clipped_frames(run.design) == 0


@pytest.mark.parametrize("name", ["cacao", "dao", "pyrtc"])
def test_a_target_that_knows_its_limit_comes_back(slow, name):
    """After a step beyond the stroke, the residual is what it was before."""
    phase = np.zeros((1200, 2))
    phase[300:600] = 100.0
    run = rehearse(slow, name, Disturbance(phase_nm=phase), hardware=PATH, stroke=50.0)
    assert np.max(np.abs(run.target.commands)) == 50
    assert 0 < run.clipped_frames(run.target) <= 300
    assert run.clipped_frames(run.design) > 500  # the plain form winds up
    back = run.target.residual_nm[0, 600 - run.settle_frames :]
    assert np.max(np.abs(back[40:])) < 0.5


def test_what_cannot_be_rehearsed_is_refused(tmp_path, slow, monkeypatch):
    """One loop is unstable by its sensor, one by the target alone."""
    several = lbt.kalman(example_plant((SLOW,)))
    series, strong = (Disturbance(phase_nm=PHASE, sensor_gain=gain) for gain in (1.0, 4.0))
    long = Disturbance(phase_nm=np.vstack([PHASE] * 3))
    eye = np.eye(2)
    wrong = lbt.Controller(A=eye, B=-0.4 * eye, C=eye, D=0 * eye, dt_s=PATH.dt_s)
    broken = replace(lbt.interop.export(tmp_path / "k.c", slow, "c"), start=lambda _: wrong.start())

    run, errors = partial(rehearse, hardware=PATH), lbt.errors
    monkeypatch.setattr("lbt_synth.interop.pipeline.export", lambda *_: broken)
    words = "of c the loop grows beyond all numbers"
    require_refusals(
        [
            (partial(run, slow, "dao", strong), errors.UnstableLoopError, None),
            (partial(run, several, "c", series), errors.ProblemError, "got one of several sensors"),
            (partial(run, slow, "c", long), errors.NumericalError, words),
        ]
    )


GAINS = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]


def modal_cases(design):
    """What is exported, its options, the controller that it is, and which modes are proved."""
    air = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=20.0, frame_rate_hz=800)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=50, direction=(1.0,))
    models = {"noise_nm": [5.0, 6.0, 7.0], "vibrations": {1: [line]}, "sensor_gain": 0.8}
    filters = modal_filters([air] * 3, hardware=PATH, **models)
    mixed = MixedController(filter=design, gains=GAINS, leak=0.99)
    others = MixedController(filter=design, gains=[0.0, 0.0, *[0.4] * 7])
    filtered = MixedController(filter=filters, gains=[0.4] * 5, filtered=[1, 2, 4])
    alone = MixedController(filter=filters, gains=[0.0] * 3, filtered=[0, 1, 2])
    options = {"modes": 9, "other_gain": 0.4}
    return {
        "mixed": (mixed, {}, mixed, ["mode 3", "modes 0 and 1", "modes 2 and 5"]),
        "others": (design, options, others, ["modes 0 and 1", "modes 2, 3, 4, 5, 6 and 2 more"]),
        "filtered": (filtered, {}, filtered, ["mode 1", "mode 2", "mode 4", "modes 0 and 3"]),
        "filters": (filters, {}, alone, ["mode 0", "mode 1", "mode 2"]),
    }


MODAL = [
    ("mixed", "c", {"form": form, "precision": precision}, limit)
    for form in ("plain", "estimator")
    for precision, limit in (("double", 1e-12), ("single", 1e-4))
]
MODAL += [("mixed", "cacao", {}, 1e-3)]
MODAL += [(kind, "dao", {}, 1e-4) for kind in ("mixed", "filtered", "filters")]
MODAL += [("others", name, {}, 1e-3) for name in ("c", "cacao", "dao", "pyrtc")]


@pytest.mark.parametrize(("kind", "name", "options", "limit"), MODAL)
def test_files_of_all_modes_are_the_controller(tmp_path, designs, kind, name, options, limit):
    """In the loop, by the program and by its twin; equal modes are proved once."""
    exported, more, control, proved = modal_cases(designs["hinf"])[kind]
    place = target_named(name).path_in(tmp_path)
    written = lbt.interop.export(place, exported, name, **options, **more)
    path = lbt.LoopHardware(frame_rate_hz=800, modes=control.n_modes)
    steps, noise = np.random.default_rng(4).standard_normal((2, 600, path.modes))
    steps[:5] = noise[:5] = 0  # until pyRTC's loop runs
    runs = [control, ORACLES[name](written.files, path, options)]
    runs += [written.start(np.inf)] * (name != "pyrtc")  # whose twin has the modes of the design
    expected, *commands = (
        np.split(recorded_run(run, path, np.cumsum(steps, axis=0), 0.1 * noise)[0], 3, axis=1)[1]
        for run in runs
    )
    for series in commands:
        assert relative(series, expected) < limit
        assert np.array_equal(series.any(axis=0), expected.any(axis=0))  # no gain, no command
    assert all(np.array_equal(commands[0], twin) for twin in commands[1:])
    names = [check.name for check in written.checks if "residual at sensor gain 1," in check.name]
    assert sorted(name.split(" (")[1].removesuffix(")") for name in names) == proved
