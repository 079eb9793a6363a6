"""The targets of an export."""

import hashlib
import json
from dataclasses import astuple, replace
from fractions import Fraction

import numpy as np
import pytest
from support.plants import ROOT
from support.recorded_runs import recorded_run
from support.sensor_loops import SLOW, example_plant
from support.written_files import ORACLES, WITHOUT_ORACLE, is_schur, judge

import lbt_synth as lbt
from lbt_synth.interop.cacao.export import predictive_filter
from lbt_synth.interop.pipeline import target_named, target_names
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop import Disturbance

CHUNK = 100


FILES = {"k.c": "c", "k.mat": "matlab", "k.npy": "dao"}
PATH = lbt.LoopHardware(frame_rate_hz=800)
PHASE = 100 * np.cumsum(np.random.default_rng(0).standard_normal((1500, 2)), axis=0) / 30


@pytest.mark.parametrize("name", target_names())
def test_a_target_says_how_it_computes(name):
    target = lbt.interop.target_named(name)
    assert all(text and text.isascii() for text in astuple(target.arithmetic))


def test_the_page_has_the_table_of_the_targets():
    page = (ROOT / "docs" / "real_time_computer.md").read_text()
    for name in target_names():
        words = astuple(lbt.interop.target_named(name).arithmetic)
        assert f"* - `{name}`\n" + "".join(f"  - {text}\n" for text in words) in page


def test_each_folder_with_an_export_is_a_target_and_has_an_oracle():
    assert {"c", "cacao", "dao", "matlab", "pyrtc"} <= set(target_names())
    assert set(target_names()) <= set(ORACLES) | WITHOUT_ORACLE
    assert not set(ORACLES) & WITHOUT_ORACLE


@pytest.mark.usefixtures("short_rehearsal")
def test_the_oracles_see_a_loop_that_is_unstable(tmp_path):
    """Files of an integrator, judged in the loop of one that is too slow for it."""
    quick = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.9)
    late = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=3), gain=0.1)
    options = {"precision": "double", "form": "plain"}
    for name, oracle in ORACLES.items():
        if name == "cacao":  # its configuration has the delay, so that this loop has none to miss
            continue
        target = lbt.interop.target_named(name)
        files = lbt.interop.export(target.path_in(tmp_path), quick, name).files
        assert oracle(files, quick, options)
        assert not oracle(files, late, options)


def test_polynomials_are_judged_exactly():
    near = Fraction(2**60 - 1, 2**60)
    assert is_schur([Fraction(1), -near])
    assert not is_schur([Fraction(1), Fraction(-1)])
    assert is_schur([Fraction(1), -2 * near, near**2, Fraction(0)])
    assert not is_schur([Fraction(1), -2 * near, 1 + Fraction(1, 2**100)])


def written_stable(folder, seeds):
    """Require that no file of these gain files is unstable; return how many were written."""
    written = dict.fromkeys(ORACLES, 0)
    for seed in seeds:
        for name, verdict in judge(folder, seed).items():
            assert verdict is not False, (name, seed)
            written[name] += verdict is not None
    return written


@pytest.mark.usefixtures("short_rehearsal")
def test_no_target_writes_an_unstable_file(tmp_path):
    assert all(written_stable(tmp_path, [6]).values())


@pytest.mark.study
@pytest.mark.parametrize("chunk", range(100))
@pytest.mark.usefixtures("short_rehearsal")
def test_no_target_writes_one_of_ten_thousand(tmp_path, chunk):
    seeds = range(CHUNK * chunk, CHUNK * (chunk + 1))
    assert all(written_stable(tmp_path, seeds).values())


@pytest.mark.usefixtures("short_rehearsal")
@pytest.mark.parametrize("file", FILES)
def test_what_no_format_takes(tmp_path, designs, file):
    target = tmp_path / file

    def export(path, design, **options):
        return lbt.interop.export(path, design, FILES[file], **options)

    with pytest.raises(lbt.errors.ProblemError, match="expected a Design; got int"):
        export(target, 3)
    failed = lbt.design.Check(name="rms", value=2.0, limit=1.0, computed_by="guess")
    with pytest.raises(lbt.errors.CertificateError, match="this one failed: rms") as caught:
        export(
            target,
            replace(
                designs["integrator"],
                certificate=lbt.design.Certificate(
                    checks=(failed,), gamma=np.nan, rms_per_output=np.zeros(0)
                ),
            ),
        )
    assert caught.value.failed == ("rms",)
    for digest in ("abc", "AB" * 32, 3, "ab" * 32 + "\n"):
        with pytest.raises(lbt.errors.ProblemError, match="64 hexadecimal digits"):
            export(target, designs["integrator"], gain_digest=digest)
    with pytest.raises(lbt.errors.OutputError, match="must end in"):
        export(tmp_path / "k.txt", designs["integrator"])
    with pytest.raises(lbt.errors.OutputError, match="cannot write"):
        export(tmp_path / "nowhere" / file, designs["integrator"])
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("short_rehearsal")
@pytest.mark.parametrize("name", target_names())
def test_the_same_design_gives_the_same_files_and_a_certificate_of_them(tmp_path, designs, name):
    own, seen = lbt.interop.target_named(name), []
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
        assert beside["arithmetic"]["program"] == own.arithmetic.program
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
        target = lbt.interop.target_named(name)
        written = lbt.interop.export(target.path_in(tmp_path), design, name)
        assert all(check.passed for check in written.checks)
        runs = [
            recorded_run(run, hardware, phase[None], np.zeros((1, 600, 2)))[0, :, :2]
            for run in (written.start(np.inf), design.controller.start())
        ]
        assert np.std(runs[0] - runs[1]) < 1e-2 * np.std(runs[1])


@pytest.mark.usefixtures("short_rehearsal")
def test_an_option_goes_with_its_target(tmp_path, designs):
    for target, option in (("dao", "form"), ("matlab", "modes"), ("c", "steps")):
        with pytest.raises(lbt.errors.ProblemError, match=f"{option} is no option of target"):
            lbt.interop.export(tmp_path / "k", designs["integrator"], target, **{option: 3})
    with pytest.raises(lbt.errors.ProblemError, match="target must be one of c, cacao"):
        lbt.interop.export(tmp_path / "k", designs["integrator"], "fpga")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("short_rehearsal")
@pytest.mark.parametrize("name", target_names())
def test_what_is_proved_is_what_was_read_from_the_file(tmp_path, designs, monkeypatch, name):
    """Each file holds numbers; where one is another when it is read, it is not written."""
    own = lbt.interop.target_named(name)

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


pytestmark = pytest.mark.usefixtures("short_rehearsal")


@pytest.fixture(scope="module")
def slow():
    return lbt.integrator(PATH, gain=0.4)


@pytest.mark.parametrize("name", target_names())
def test_each_target_runs_beside_the_design(slow, name):
    noise = np.random.default_rng(1).standard_normal((1500, 2))
    run = lbt.interop.rehearse(
        slow, name, Disturbance(phase_nm=PHASE, noise=noise, sensor_gain=0.8)
    )
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
    run = lbt.interop.rehearse(slow, name, Disturbance(phase_nm=phase), stroke=50.0)
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
    run = lbt.interop.rehearse(quick, name, Disturbance(phase_nm=total), stroke=60.0)
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
        lbt.interop.rehearse(slow, "c", Disturbance(phase_nm=np.vstack([PHASE] * 3)))


def test_what_cannot_be_rehearsed_is_refused(slow):
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    several = lbt.kalman(example_plant((SLOW,)))
    problem = lbt.errors.ProblemError
    series, strong = (Disturbance(phase_nm=PHASE, sensor_gain=gain) for gain in (1.0, 4.0))
    narrow = Disturbance(phase_nm=PHASE[:, :1])
    for given, error, words in (
        ((slow, "dao", narrow), lbt.errors.DimensionError, r"\(frames, 2\)"),
        ((slow, "dao", PHASE), problem, "disturbance must be a Disturbance"),
        ((slow, "dao", strong), lbt.errors.UnstableLoopError, None),
        ((bare, "dao", series), problem, "bare estimation problem"),
        ((several, "c", series), problem, "got one of several sensors"),
    ):
        with pytest.raises(error, match=words):
            lbt.interop.rehearse(*given)
