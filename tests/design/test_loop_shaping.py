"""Loop shaping: designs against closed forms, other means and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from support.refusals import require_refusals
from support.robust_config import EXAMPLE
from support.shaping import BASIC, NOISE, ONE, RATE, SLOW, attenuation, margin, shaped, spec

import lbt_synth as lbt
from lbt_synth.design.shaping import Bound, CommandRms, LoopErrors, ResidualVariance, VibrationBand
from lbt_synth.errors import InfeasibleError, ProblemError
from lbt_synth.loop.budget import ensemble_residuals
from lbt_synth.loop.ensemble import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.models import ARModel


def plant_of(turbulence=SLOW, noise_nm=NOISE, **options):
    facts = {"frame_rate_hz": RATE, "turbulence": turbulence, "noise_nm": noise_nm}
    return lbt.tip_tilt_plant(**facts, **options)


def test_nothing_to_reject_leaves_nothing():
    idle = ResidualVariance(turbulence=None, noise_nm=10, sensor_gain=0.5)
    design = shaped(margin(0.5), terms=[idle], functions=8)
    assert design.objective_nm[0] < 1e-3


@pytest.mark.parametrize(("delay", "coefficients"), [(1.0, [0.99]), (3.0, [1.9, -0.93])])
def test_without_demands_the_optimum_is_the_kalman_filter(delay, coefficients):
    model = ARModel(coefficients=coefficients, driving_rms_nm=20.0, frame_rate_hz=RATE)
    plant = plant_of(model, modes=1, delay_frames=delay)
    terms = [ResidualVariance(turbulence=model, noise_nm=NOISE)]
    design = shaped(terms=terms, path=plant.hardware, functions=30)
    best = lbt.kalman(plant).rms
    assert best * (1 - 1e-7) <= design.objective_nm[0] <= best * 1.002


def test_few_poles_reach_the_kalman_filter_too():
    design = shaped(functions=24, states=8, loss=0.01)
    assert design.states_per_mode <= 8
    assert design.objective_nm[0] <= lbt.kalman(plant_of(modes=1)).rms * 1.012
    assert design.loss <= 0.01
    assert shaped(states=4, loss=0.01).states_per_mode == 2  # as few as are needed
    loud = [BASIC, VibrationBand(low_hz=15, high_hz=25, rms_nm=500)]
    with pytest.raises(InfeasibleError, match="no controller of 5 states per mode came within 1 %"):
        shaped(terms=loud, functions=30, states=5, loss=0.01)


def test_every_demand_holds_in_a_loop_measured_by_other_means():
    demands = (
        margin(0.55),
        Bound(response="noise", at_most=1.9),
        attenuation(0, 2, 0.12),
        attenuation(4, 6, 0.5, sensor_gain=0.6),
        LoopErrors(low=0.3, high=1.6),
        Bound(response="complementary", at_most=1 / 0.7, low_hz=150, high_hz=400),
        LoopErrors(delay_frames=0.5),
        CommandRms(at_most_nm=40, turbulence=SLOW, noise_nm=NOISE, rate=True),
    )
    design, free = shaped(*demands, functions=30), shaped(functions=30)
    assert design.objective_nm[0] > free.objective_nm[0]
    loop, weak = (lbt.close_loop(ONE, design.controller, sensor_gain=g) for g in (1.0, 0.6))
    f = np.linspace(0, 400, 8001)
    S = loop.sensitivity(f)[:, 0, 0]
    noise = loop.path("noise", "residual").frequency_response(f)
    for response, at_most in (
        (S, 1 / 0.55),
        (noise, 1.9),
        (S[f <= 2], 0.12),
        (weak.sensitivity(f[(f >= 4) & (f <= 6)]), 0.5),
        (1 - S[f >= 150], 1 / 0.7),
    ):
        assert np.max(np.abs(response)) < at_most
    low, high = lbt.loop.stable_sensor_gains(ONE, design.controller)
    assert low < 0.3 < 1.6 < high
    assert lbt.loop_margins(loop).delay_frames > 0.5
    truth = lbt.Truth(turbulence=SLOW, noise_nm=NOISE)
    size = {"frames": 40_000, "seed": 1, "settle_frames": 2000}
    run = lbt.simulate(design.controller, truth, hardware=ONE, **size)
    assert np.std(np.diff(run.commands[0, :, 0])) < 40 * 1.03


def test_each_mode_may_have_its_own_specification():
    line = [BASIC, VibrationBand(low_hz=19, high_hz=21, rms_nm=100)]
    sensor = [[1.0, 0.3], [-0.2, 0.9], [0.4, 0.0]]
    mirror = [[0.8, 0.1, 0.0], [0.0, 0.5, 0.4]]
    path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=sensor, influence_matrix=mirror)
    design = lbt.design.shape(path, [spec(), spec(terms=line)], functions=20, states=None)
    assert design.certificate.passed
    assert design.objective_nm[0] < design.objective_nm[1]
    rejected = np.abs(lbt.close_loop(path, design.controller).sensitivity([20.0])[0])
    assert rejected[1, 1] < 0.5 * rejected[0, 0]
    assert max(rejected[0, 1], rejected[1, 0]) < 1e-9


def test_robust_scales_the_noise_with_the_sensor_and_shares_equal_modes():
    tiny = ARModel(coefficients=[0.99], driving_rms_nm=1e-11, frame_rate_hz=RATE)
    for model, noise, gain in ((SLOW, NOISE, 2.0), (tiny, 4e-10, 3.0)):  # of any size
        plant = plant_of(model, noise, sensor_matrix=np.diag([1.0, gain]))
        design = lbt.robust(plant, bands=[], functions=8, states=None)
        noises = [s.terms[0].noise_nm for s in design.specifications]
        assert noises == pytest.approx([noise, noise / gain], rel=1e-6)
    same = lbt.robust(plant_of(), bands=[], functions=8, states=None)
    assert same.specifications[0].key == same.specifications[1].key
    assert same.first_equal_modes == [0, 0]
    assert same.method == "robust"


def test_what_makes_no_sense_is_refused():
    one, shape = plant_of(modes=1), lbt.design.shape
    other = ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=100)
    flat = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[1.0, 1.0]])
    command = {"at_most_nm": 9, "turbulence": SLOW, "noise_nm": 1}
    slower, peak = CommandRms(**command | {"turbulence": other}), margin(0.5)
    high, noise = VibrationBand(low_hz=5, high_hz=500, rms_nm=1), {"response": "noise"}
    rows = [
        (lambda: ResidualVariance(turbulence=None, noise_nm=0), "turbulence or noise; got neither"),
        (lambda: ResidualVariance(turbulence=3, noise_nm=1), "must be an Atmosphere"),
        (lambda: ResidualVariance(turbulence=SLOW, noise_nm=-1), "noise_nm must be at least 0"),
        (lambda: VibrationBand(low_hz=5, high_hz=5, rms_nm=1), "high_hz must be above 5"),
        (lambda: VibrationBand(low_hz=5, high_hz=6, rms_nm=0), "rms_nm must be above 0"),
        (lambda: spec(terms=()), "at least one term"),
        (lambda: spec(terms=(3,)), "terms must be of ResidualVariance, VibrationBand; got int"),
        (lambda: spec(terms=BASIC), "terms must be a list"),
        (lambda: Bound(**noise, at_most=0), "at_most must be above 0"),
        (lambda: Bound(**noise, at_most=1, sensor_gain=2), "on noise is at sensor gain 1; got 2"),
        (lambda: Bound(response="S", at_most=1), "response must be"),
        (lambda: attenuation(2, 1, 1), "high_hz must be above 2"),
        (lambda: attenuation(0, 1, 3, sensor_gain=0.5), "below 2 at sensor gain 0.5"),
        (lambda: LoopErrors(low=1.1, high=1.3), "low must be at most 1"),
        (lambda: LoopErrors(low=0.5, high=0.9), "high must be at least 1"),
        (lambda: LoopErrors(delay_frames=1.5), "frames must be at most 1"),
        (lambda: LoopErrors(delay_frames=0.5, moving=True), "in which a gain may move"),
        (lambda: CommandRms(**command | {"at_most_nm": -1}), "at_most_nm must be above 0"),
        (lambda: CommandRms(**command, rate="x"), "rate must be True or False"),
        (lambda: spec(3), "demands must be of Bound, CommandRms, LoopErrors; got int"),
        (lambda: spec(peak, peak), "given once; got twice 'modulus margin"),
        (
            lambda: lbt.design.shaping.Specification(terms=[BASIC], demands=peak),
            "demands must be a list",
        ),
        (lambda: shape(3, spec()), "such as plant.hardware, must be a LoopHardware; got int"),
        (lambda: shape(ONE, 3), "expected a Specification"),
        (lambda: shape(ONE, [spec(), spec()]), "one for each of 1 modes; got 2"),
        (lambda: shape(ONE, spec(), functions=401), "functions must be at most 400"),
        (lambda: shape(ONE, spec(), pole=1.0), "pole must be below 1"),
        (lambda: shape(ONE, spec(), states=1), "states must be at least 2"),
        (lambda: shape(ONE, spec(terms=[high])), "Nyquist frequency 400 Hz; got 5 to 500"),
        (lambda: shape(flat, spec()), "sensor_matrix must have rank 2"),
        (lambda: shape(ONE, spec(slower)), "sampled at the loop's 800 Hz; got 100"),
        (lambda: lbt.robust(one, bands=None), "bands must be a list"),
        (lambda: lbt.robust(one, bands=[], sensor_gain=(1,)), r"must be \(low, high\)"),
        (lambda: lbt.robust(one, bands=[], scenarios=1.0), "scenarios must be a list"),
        (lambda: lbt.robust(one, bands=[], scenarios=[]), "at least one sensor gain"),
        (lambda: lbt.robust(one, modulus_margin=1), "modulus_margin must be below 1"),
        (lambda: lbt.robust(one, bands=[3]), "each of bands must be a VibrationBand"),
        (lambda: lbt.loop.least_residual(None, None), "expected a LoopHardware"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


def test_the_example_holds_at_every_row_and_sensor_gain(tmp_path):
    """It has 40 functions in place of 60: the design takes half as long."""
    path = tmp_path / "fewer.yaml"
    path.write_text(EXAMPLE.read_text().replace("    loss:", "    functions: 40\n    loss:"))
    config = lbt.load_config(path)
    example = config.design("robust")
    camera = replace(config.imaging, other_modes=0.841)
    noise = replace(config.truth, noise_nm=15.5)
    (line,), errors_hz, gains = noise.vibrations, np.arange(-7, 8) / 2, [1, 0.7, 0.5, 0.358]
    frequency_hz = np.tile(line.frequency_hz + errors_hz, len(gains))
    facts = {"rms_nm": line.rms_nm, "direction": line.direction}
    moved = EnsembleVibration(frequency_hz=frequency_hz, **facts)
    facts = {"sensor_gain": np.repeat(gains, errors_hz.size), "noise_nm": 15.5}
    ensemble = LoopEnsemble(turbulence=noise.turbulence, vibrations=[moved], **facts)

    def worst_strehl(frame_means):
        loops = textbook_matrices([example.controller]), config.hardware, ensemble
        residuals = lbt.strehl(ensemble_residuals(*loops, frame_means=frame_means), camera)
        return 100 * np.min(residuals.reshape(len(gains), -1), axis=1)

    means, worst = worst_strehl(True), worst_strehl(False)
    assert np.all(means >= [83, 82.5, 82, 80.5])
    assert np.all(means <= 84.1)
    # what moves within frames dims the image by 1 % at most
    assert np.all((means - 1.5 < worst) & (worst < means))
