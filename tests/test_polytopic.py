"""Filters for an interval of vibration frequencies, and frequency priors."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.worst_case import bound_worst_error, error_size, search_worst_error
from lbt_synth.files.gain_file import store
from lbt_synth.linear.norms import band_norm
from lbt_synth.models.plant.frequency_interval import FrequencyInterval

RATE = 800


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def made(plant):
    return {
        (norm, half): lbt.design.polytopic(plant, half_width_hz=half, norm=norm)
        for norm in ("hinf", "h2")
        for half in (0.0, 0.2, 1.0, 2.0)
    }


def predictor(design):
    """Filter from ybar to the next z, of a design with a gain."""
    return lbt.EstimationProblem.controller(design.problem, design.gain_predictor)


# -- the interval ---------------------------------------------------------------
def test_the_plants_of_an_interval_are_a_segment(plant):
    interval = FrequencyInterval(plant=plant, half_width_hz=1.0)
    line = plant.vibrations[0]
    for f in (19.0, 19.3, 20.0, 21.0):
        model = lbt.Vibration(frequency_hz=f, damping=0.2 / f, rms_nm=1.0).ar_model(RATE)
        a1 = interval.coefficient(f)
        np.testing.assert_allclose([a1, -interval.retention], model.coefficients, rtol=1e-13)
        assert interval.frequency_hz(a1) == pytest.approx(f, rel=1e-11)
        A = interval.state_matrix(a1)
        np.testing.assert_allclose(A[0, :2], model.coefficients, rtol=1e-13)
        A = A.copy()
        A[0, 0] = plant.A[0, 0]
        np.testing.assert_allclose(A, plant.A, rtol=1e-13)
    assert interval.coefficients[0] < interval.coefficients[1]
    assert line.moved(19.0).ar_model(RATE).rms_nm == pytest.approx(line.rms_nm, rel=1e-12)


def test_norms_over_a_band():
    lag = lbt.linear.StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt_s=0.01)
    assert band_norm(lag, 0.0, 50.0).value == pytest.approx(lbt.hinf_norm(lag).value, rel=1e-12)
    edge = abs(1 / (np.exp(2j * np.pi * 0.1) - 0.5))
    assert band_norm(lag, 10.0, 50.0).value == pytest.approx(edge, rel=1e-12)
    line = lbt.linear.StateSpace(A=[[1.9, -0.99], [1, 0]], B=[[1.0], [0]], C=[[1.0, 0]], D=[[0.0]])
    whole = lbt.hinf_norm(line)
    f = whole.peak_frequency_hz
    assert band_norm(line, f / 2, 2 * f).value == pytest.approx(whole.value, rel=1e-10)
    below = band_norm(line, 0.0, f / 2)
    assert below.value == pytest.approx(
        float(lbt.linear.largest_singular_values(line, [f / 2])[0]), rel=1e-10
    )


@pytest.mark.parametrize("modes", [1, 2])
@pytest.mark.parametrize("shift", [-1.7, 0.0, 0.6])
def test_guarantee_and_search_meet_for_any_filter(modes, shift):
    """The two computations of the worst case, on filters whose worst frequency is anywhere."""
    plant = lbt_axis_plant(modes=modes, damping=0.02)
    interval = FrequencyInterval(plant=plant, half_width_hz=2.0)
    wide = [dataclasses.replace(v.moved(20 + shift), rms_nm=200.0) for v in plant.vibrations]
    other = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=plant.turbulence, vibrations=wide, noise_nm=15.5, modes=modes
    )
    for filtered in (
        predictor(lbt.kalman(other)),
        predictor(lbt.hinf(other, gamma_ratio=1.3, route="riccati")),
    ):
        for norm, gap in (("hinf", 1e-8), ("h2", 6e-5)):
            found, where = search_worst_error(interval, filtered, norm)
            sure = bound_worst_error(interval, filtered, norm)
            assert found * (1 - 1e-10) <= sure <= found * (1 + gap)
            assert interval.low_hz <= where <= interval.high_hz


def test_a_worst_frequency_inside_the_interval():
    """The envelope decides, not the ends: a filter that knows the ends and not the middle."""
    plant = lbt_axis_plant()
    interval = FrequencyInterval(plant=plant, half_width_hz=1.0)
    ends = lbt.models.spread_plant(plant, frequencies_hz=[19.0, 21.0])
    filtered = predictor(lbt.kalman(ends))
    at_ends = max(
        error_size(interval.error_system(a, filtered), "hinf") for a in interval.coefficients
    )
    found, where = search_worst_error(interval, filtered, "hinf")
    sure = bound_worst_error(interval, filtered, "hinf")
    assert found > 1.5 * at_ends
    assert 19.1 < where < 20.9
    assert found * (1 - 1e-10) <= sure <= found * (1 + 1e-8)


# -- the designs ----------------------------------------------------------------
@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_the_bar(made, norm):
    design = made[norm, 1.0]
    assert design.method == f"polytopic-{norm}"
    assert design.certificate.passed
    assert design.worst_achieved <= design.bound_guaranteed <= 1.0001 * design.worst_achieved
    # the programme's own bound is a bound as well, and close
    assert design.bound_guaranteed <= design.bound_programme <= 1.03 * design.worst_achieved
    assert design.predictor.n_states == 4
    assert design.controller.n_states == 4 + 1
    assert max(abs(design.poles)) < 1


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_nowhere_on_the_interval_is_it_worse(made, norm):
    design = made[norm, 1.0]
    for f in np.random.default_rng(5).uniform(19, 21, 200):
        a1 = design.interval.coefficient(float(f))
        size = error_size(design.interval.error_system(a1, design.predictor), norm)
        assert size <= design.bound_guaranteed * (1 + 1e-9)


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_a_wider_interval_has_a_larger_bound(made, norm):
    bounds = [made[norm, half].bound_guaranteed for half in (0.0, 0.2, 1.0, 2.0)]
    assert all(after > 1.001 * before for before, after in itertools.pairwise(bounds))


def test_no_interval_is_the_nominal_design(plant, made):
    least, kalman = lbt.hinf(plant, route="riccati"), lbt.kalman(plant)
    assert made["hinf", 0.0].bound_guaranteed == pytest.approx(least.gamma_least, rel=1e-6)
    assert made["h2", 0.0].bound_guaranteed == pytest.approx(kalman.rms, rel=1e-6)
    assert made["h2", 0.0].gamma == pytest.approx(kalman.gamma, rel=1e-2)


def test_it_beats_the_nominal_filters_on_the_interval(plant, made):
    nominal = {
        "hinf": lbt.hinf(plant, route="riccati"),
        "h2": lbt.kalman(plant),
    }
    for norm, factor in (("hinf", 3.0), ("h2", 1.01)):
        interval = made[norm, 1.0].interval
        worst, _ = search_worst_error(interval, predictor(nominal[norm]), norm)
        assert worst > factor * made[norm, 1.0].bound_guaranteed


def test_the_plant_at_an_end_in_the_loop(made):
    """The residual of the closed loop is the estimation error, at the centre and at an end."""
    design = made["h2", 1.0]
    loop = lbt.close_loop(design.hardware, design.controller)
    for f in (20.0, 19.0):
        line = design.problem.vibrations[0]
        drive = line.ar_model(RATE).driving_rms_nm
        moved = line.moved(f)
        moved = dataclasses.replace(
            moved, rms_nm=moved.rms_nm * drive / moved.ar_model(RATE).driving_rms_nm
        )
        truth = lbt.Truth(
            turbulence=design.problem.turbulence[0], vibrations=(moved,), noise_nm=15.5
        )
        a1 = design.interval.coefficient(f)
        size = error_size(design.interval.error_system(a1, design.predictor), "h2")
        assert lbt.residual_budget(loop, truth).rms_nm == pytest.approx(size, rel=1e-8)


def test_two_axes(made):
    decoupled = lbt.design.polytopic(lbt_axis_plant(modes=2), half_width_hz=1.0)
    assert decoupled.bound_guaranteed == pytest.approx(made["hinf", 1.0].bound_guaranteed, rel=1e-4)
    variance = lbt.design.polytopic(lbt_axis_plant(modes=2), half_width_hz=1.0, norm="h2")
    expected = np.sqrt(2) * made["h2", 1.0].bound_guaranteed
    assert variance.bound_guaranteed == pytest.approx(expected, rel=1e-4)


def test_coupled_axes_and_an_axis_without_vibration(made):
    slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=RATE)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    across = dataclasses.replace(line, direction=(1.0, 1.0))
    common = {"frame_rate_hz": RATE, "turbulence": slow, "noise_nm": 15.5}
    alone = lbt.design.polytopic(lbt.tip_tilt_plant(vibrations=[line], **common), half_width_hz=1.0)
    turned = lbt.design.polytopic(
        lbt.tip_tilt_plant(vibrations=[across], **common), half_width_hz=1.0
    )
    # the same plant in turned axes
    assert turned.bound_guaranteed == pytest.approx(alone.bound_guaranteed, rel=1e-3)
    assert alone.bound_guaranteed == pytest.approx(made["hinf", 1.0].bound_guaranteed, rel=1e-2)


def test_states_that_are_sums_of_others(plant):
    """With AR2 turbulence and two frames the past total is the sum of two other states."""
    turbulence = lbt.models.ARModel(
        coefficients=[1.9, -0.905], driving_rms_nm=5, frame_rate_hz=RATE
    )
    redundant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=turbulence,
        vibrations=plant.vibrations,
        noise_nm=15.5,
        modes=1,
    )
    design = lbt.design.polytopic(redundant, half_width_hz=1.0)
    assert (redundant.n_states, design.predictor.n_states) == (5, 4)
    assert design.bound_guaranteed < 1.02 * design.worst_achieved


def test_another_horizon_is_another_delay(plant):
    design = lbt.design.polytopic(plant, half_width_hz=0.5, horizon=2)
    assert design.hardware.delay_frames == 3
    assert design.bound_guaranteed > lbt.hinf(plant, horizon=2, route="riccati").gamma_least


def test_wrong_demands(plant):
    lines = [plant.vibrations[0], plant.vibrations[0].retuned(30, frame_rate_hz=RATE)]
    common = {
        "frame_rate_hz": RATE,
        "turbulence": plant.turbulence[0],
        "noise_nm": 15.5,
        "modes": 1,
    }
    two, none = lbt.tip_tilt_plant(vibrations=lines, **common), lbt.tip_tilt_plant(**common)
    for wrong, arguments, text in (
        (two, {}, "one uncertain frequency at a time.*20 Hz with 0.01 and 30 Hz"),
        (none, {}, "needs a vibration; got a plant without any"),
        (plant.full(), {}, "needs a TipTiltPlant; got FullStatePlant"),
        (lbt.mixed(plant, gamma_ratio=1.1, taps=2).problem, {}, "holds the memory"),
        (plant, {"norm": "h1"}, "norm must be one of hinf, h2; got 'h1'"),
        (plant, {"half_width_hz": -1}, "half_width_hz must be at least 0"),
        (plant, {"half_width_hz": np.nan}, "half_width_hz must be finite"),
        (plant, {"half_width_hz": 20.0}, "decays at 0.2 Hz .* got 0 Hz"),
        (plant, {"half_width_hz": 381.0}, "got -361 Hz"),
        (plant, {"horizon": 0.5}, "horizon must be an integer"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=text):
            lbt.design.polytopic(wrong, **{"half_width_hz": 1.0, **arguments})
    high = lbt.tip_tilt_plant(
        vibrations=[lbt.Vibration(frequency_hz=395, damping=0.01, rms_nm=9, direction=(1,))],
        **common,
    )
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 401 Hz"
    ):
        lbt.design.polytopic(high, half_width_hz=6)


def test_a_solver_that_fails_or_lies_is_not_believed(plant, monkeypatch):
    from lbt_synth.linear.lmi import polytopic as programmes

    monkeypatch.setattr(programmes, "solve", lambda *_: ("infeasible", 3))
    with pytest.raises(lbt.errors.NumericalError, match="ended as 'infeasible'.*narrower"):
        lbt.design.polytopic(plant, half_width_hz=1.0)
    unstable = programmes.SegmentFilter(
        A=1.01 * np.eye(4),
        B=np.ones((4, 1)),
        C=np.ones((1, 4)),
        bound=1.0,
        status="optimal",
        iterations=1,
    )
    monkeypatch.setattr("lbt_synth.linear.lmi.polytopic.segment_filter", lambda *_, **__: unstable)
    with pytest.raises(lbt.errors.CertificateError, match="spectral radius of plant and filter"):
        lbt.design.polytopic(plant, half_width_hz=1.0)


def test_a_line_too_narrow_to_be_bounded(made):
    sharp = lbt_axis_plant(damping=1e-7)
    interval = FrequencyInterval(plant=sharp, half_width_hz=2.0)
    with pytest.raises(lbt.errors.NumericalError, match="too narrow a line"):
        bound_worst_error(interval, made["h2", 1.0].predictor, "h2")


def test_claims_that_do_not_hold(made):
    design = made["hinf", 1.0]
    for change, failed in (
        ({"bound_guaranteed": 0.99 * design.bound_guaranteed}, "bound over the interval"),
        ({"worst_achieved": 0.9 * design.worst_achieved}, "worst error found over the one stated"),
        ({"worst_frequency_hz": 20.3}, "worst error stated, against that at its frequency"),
        ({"half_width_hz": 1.1}, "bound over the interval"),
        ({"half_width_hz": 0.9}, "distance of that frequency"),
        ({"controller": made["h2", 1.0].controller}, "controller, against"),
        ({"predictor": made["h2", 1.0].predictor}, "bound over the interval"),
    ):
        names = [
            c.name for c in dataclasses.replace(design, **change).recertify().checks if not c.passed
        ]
        assert any(name.startswith(failed) for name in names), (change, names)


# -- frequency priors -----------------------------------------------------------
def test_the_spectrum_is_the_mean_of_the_moved_ones(plant):
    weights = [1.0, 2.0, 4.0, 1.0]
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4, weights=weights)
    line = plant.vibrations[0]
    f = np.concatenate([np.linspace(0, 400, 300), np.linspace(18, 22, 300)])
    moved = [line.moved(g).ar_model(RATE).psd(f) for g in (19.25, 19.75, 20.25, 20.75)]
    total = sum(part.ar_model(RATE).psd(f) for part in spread.vibrations)
    np.testing.assert_allclose(total, np.average(moved, axis=0, weights=weights), rtol=1e-11)
    assert np.hypot.reduce([v.rms_nm for v in spread.vibrations]) == pytest.approx(line.rms_nm)
    for part in spread.vibrations:
        assert part.damping * part.frequency_hz == pytest.approx(0.2)
        assert part.direction == line.direction
    assert lbt.kalman(spread).certificate.passed


def test_the_prior_filter_is_the_best_on_average(plant):
    """Of the filters at hand it has the least mean variance over the frequencies of the prior."""
    frequencies = [19.2, 19.6, 20.0, 20.4, 20.8]
    spread = lbt.models.spread_plant(plant, frequencies_hz=frequencies)
    line = plant.vibrations[0]
    plants = [
        lbt.tip_tilt_plant(
            frame_rate_hz=RATE,
            turbulence=plant.turbulence,
            vibrations=[line.moved(f)],
            noise_nm=15.5,
            modes=1,
        )
        for f in frequencies
    ]
    from lbt_synth.models.plant.frequency_interval import error_system

    def mean(filtered):
        return np.mean([error_size(error_system(p, filtered), "h2") ** 2 for p in plants])

    best = lbt.kalman(spread)
    assert mean(predictor(best)) == pytest.approx(best.rms**2, rel=1e-8)
    for other in (lbt.kalman(plant), lbt.hinf(plant, route="riccati"), lbt.kalman(plants[0])):
        assert mean(predictor(other)) > 1.005 * best.rms**2


def test_one_line_at_the_centre_is_the_plant_itself(plant):
    np.testing.assert_allclose(
        lbt.models.spread_plant(plant, half_width_hz=1.0, lines=1).A, plant.A, rtol=1e-12
    )
    two = lbt_axis_plant(modes=2)
    assert len(lbt.models.spread_plant(two, half_width_hz=1.0, lines=3).vibrations) == 6


def test_priors_that_cannot_be(plant):
    common = {
        "frame_rate_hz": RATE,
        "turbulence": plant.turbulence[0],
        "noise_nm": 15.5,
        "modes": 1,
    }
    lines = [plant.vibrations[0], plant.vibrations[0].retuned(30, frame_rate_hz=RATE)]
    two, none = lbt.tip_tilt_plant(vibrations=lines, **common), lbt.tip_tilt_plant(**common)
    for wrong, arguments, text in (
        (none, {"half_width_hz": 1.0}, "needs a plant with a vibration"),
        (plant, {}, "give one of half_width_hz and frequencies_hz"),
        (plant, {"half_width_hz": 1.0, "frequencies_hz": [20.0]}, "give one of"),
        (plant, {"half_width_hz": 0.0}, "half_width_hz must be above 0"),
        (plant, {"half_width_hz": 20.0}, "half_width_hz must be below 20; got 20. All"),
        (plant, {"half_width_hz": 1.0, "lines": 0}, "lines must be at least 1"),
        (plant, {"half_width_hz": 1.0, "lines": 65}, "lines must be at most 64"),
        (plant, {"half_width_hz": 1.0, "weights": [1.0]}, "weights must be 5 positive numbers"),
        (plant, {"frequencies_hz": [19.0, 21.0], "weights": [1.0, 0.0]}, "weights must be 2"),
        (plant, {"frequencies_hz": [19.0, 401.0]}, "below the Nyquist frequency"),
        (plant, {"frequencies_hz": [-1.0]}, "got -1 Hz"),
        (plant, {"frequencies_hz": [np.inf]}, "frequencies_hz must be finite"),
        (
            two,
            {"frequencies_hz": [19.0]},
            "vibrations of one frequency; got vibrations at 20 and 30",
        ),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=text):
            lbt.models.spread_plant(wrong, **arguments)


GOOD = YAML(typ="safe", pure=True).load(LBT_YAML.read_text())


def written(tmp_path, **vibration):
    content = copy.deepcopy(GOOD)
    content["model"]["vibrations"][0] |= vibration
    path = tmp_path / "c.yaml"
    with path.open("w") as stream:
        YAML(typ="safe", pure=True).dump(content, stream)
    return path


def test_priors_of_a_configuration(tmp_path):
    plain = lbt.load_config(LBT_YAML).plant
    for keys, lines in (({"spread_hz": 1.0}, 5), ({"spread_hz": 0.5, "lines": 2}, 2)):
        plant = lbt.load_config(written(tmp_path, **keys)).plant
        expected = lbt.models.spread_plant(plain, half_width_hz=keys["spread_hz"], lines=lines)
        assert len(plant.vibrations) == 2 * lines
        np.testing.assert_allclose(plant.A, expected.A, rtol=1e-13)
        np.testing.assert_allclose(plant.B, expected.B, rtol=1e-11)
    for keys, text in (
        ({"lines": 3}, r"vibrations\[0\]: lines goes with spread_hz, and only with it"),
        ({"spread_hz": 20.0}, r"model.vibrations\[0\].spread_hz: the half width must be below 20"),
        ({"spread_hz": -1.0}, "greater than 0"),
        ({"spread_hz": 1.0, "lines": 65}, "less than or equal to 64"),
        ({"frequency_hz": 399.0, "spread_hz": 9.0}, r"vibrations\[0\].spread_hz: .*Nyquist"),
    ):
        with pytest.raises(lbt.errors.ConfigError, match=text):
            lbt.load_config(written(tmp_path, **keys))


# -- files and the command line -------------------------------------------------
@pytest.mark.parametrize("ending", ["fits", "npz", "json"])
def test_round_trip(tmp_path, made, ending):
    design = made["hinf", 1.0]
    back = lbt.load_gain(lbt.save_gain(tmp_path / f"p.{ending}", design))
    assert isinstance(back, lbt.design.PolytopicDesign)
    for field in (
        "method",
        "norm",
        "half_width_hz",
        "bound_guaranteed",
        "worst_achieved",
        "worst_frequency_hz",
        "bound_programme",
        "gamma",
        "rms",
    ):
        assert getattr(back, field) == getattr(design, field)
    for name in "ABC":
        assert np.array_equal(getattr(back.predictor, name), getattr(design.predictor, name))
    assert back.problem.vibrations == design.problem.vibrations
    assert back.recertify().passed


def edited(tmp_path, design, change):
    path = lbt.save_gain(tmp_path / "p.json", design)
    document = json.loads(path.read_text())
    change(document)
    arrays = {k: np.array(v, dtype=float) for k, v in document["arrays"].items()}
    document["meta"]["digest"] = store._digest(arrays, document["meta"])
    path.write_text(json.dumps(document))
    return path


def test_a_tampered_file_is_not_verified(tmp_path, made, capsys):
    from lbt_synth.cli.main import main

    def promise(document):
        document["meta"]["interval"]["bound_guaranteed"] *= 0.98

    def bend(document):
        document["arrays"]["PREDICTOR_B"][0][0] *= 1.001

    def destabilise(document):
        document["arrays"]["PREDICTOR_A"] = (1.5 * np.eye(4)).tolist()

    for change in (promise, bend, destabilise):
        path = edited(tmp_path, made["hinf", 1.0], change)
        assert main(["verify", str(path)]) == 1
        assert "NOT VERIFIED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("norm", "h2", "not of the norm h2"),
        ("worst_achieved", 0.0, "worst_achieved must be above 0"),
        ("bound_guaranteed", "low", "bound_guaranteed must be a number"),
        ("half_width_hz", 30.0, "decays at"),
        ("worst_frequency_hz", 500.0, "Nyquist"),
    ],
)
def test_nonsense_is_inconsistent(tmp_path, made, key, value, text):
    def change(document):
        document["meta"]["interval"][key] = value

    path = edited(tmp_path, made["hinf", 1.0], change)
    with pytest.raises(lbt.errors.GainFileError, match=f"inconsistent: .*{text}"):
        lbt.load_gain(path)


def test_a_file_without_its_plant_or_filter(tmp_path, made):
    def kind(document):
        document["meta"]["problem"] = "problem"

    def lost(document):
        del document["arrays"]["PREDICTOR_C"]

    def crooked(document):
        document["arrays"]["PREDICTOR_C"] = [[1.0, 2.0]]

    for change, text in (
        (kind, "needs a plant"),
        (lost, "PREDICTOR_C is missing"),
        (crooked, "C must have"),
    ):
        with pytest.raises(lbt.errors.GainFileError, match=text):
            lbt.load_gain(edited(tmp_path, made["hinf", 1.0], change))


def test_the_command_line(tmp_path, capsys):
    from lbt_synth.cli.main import main

    config, target = str(LBT_YAML), str(tmp_path / "p.fits")
    design = ["design", config, "--method", "polytopic", "-o", target]
    assert main([*design, "--half-width-hz", "0.5", "--norm", "h2"]) == 0
    assert main([*design, "--half-width-hz", "0.5"]) == 0
    capsys.readouterr()
    assert main(["show", target, "--matrices"]) == 0
    out = capsys.readouterr().out
    for text in (
        "norm on the interval, guaranteed",
        "norm on the interval, worst found",
        "guaranteed over found",
        "1.000000",
        "predictor_A",
    ):
        assert text in out
    assert main(["show", target, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["guaranteed_over_found"] == pytest.approx(1.0, abs=1e-6)
    assert shown["method"] == "polytopic-hinf"
    assert main(["verify", target]) == 0
    assert main(["sigma", target, "-o", str(tmp_path / "s.png")]) == 0
    assert main(["simulate", config, target, "--frames", "400", "--cases", "1"]) == 0
    capsys.readouterr()
    for wrong, text in (
        (design, "needs the half width of the interval of frequencies; try --half-width-hz 1"),
        (
            [*design, "--half-width-hz", "1", "--gamma", "200"],
            "--gamma goes with --method hinf or mixed; got --method polytopic",
        ),
        ([*design, "--half-width-hz", "1", "--taps", "3"], "--taps goes with --method mixed"),
        (
            [*design, "--half-width-hz", "1", "--route", "lmi"],
            "--method polytopic takes no --route",
        ),
        ([*design, "--half-width-hz", "25"], "must have a frequency above that"),
        (
            ["design", config, "--method", "kalman", "--norm", "h2", "-o", target],
            "--norm goes with --method polytopic; got --method kalman",
        ),
        (
            ["design", config, "--method", "hinf", "--half-width-hz", "1", "-o", target],
            "--half-width-hz goes with --method polytopic",
        ),
        (
            [
                "design",
                str(written(tmp_path, spread_hz=1.0)),
                "--method",
                "polytopic",
                "--half-width-hz",
                "1",
                "-o",
                target,
            ],
            "one uncertain frequency at a time",
        ),
    ):
        assert main(wrong) == 2
        assert text in capsys.readouterr().err


def test_the_sigma_figure_draws_its_error(made):
    figure = lbt.report.figures.sigma_figure({"interval": made["hinf", 1.0]}, unit_weights=True)
    assert len(figure.axes) == 3


@pytest.mark.study
@pytest.mark.parametrize("norm", ["hinf", "h2"])
@pytest.mark.parametrize("damping", [0.001, 0.0051, 0.05, 0.3])
@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 3.0, 4.0])
def test_other_dampings_and_delays(norm, damping, delay):
    for half in (0.1, 1.0, 3.0):
        plant = lbt_axis_plant(damping=damping, delay_frames=delay)
        design = lbt.design.polytopic(plant, half_width_hz=half, norm=norm)
        assert design.bound_guaranteed <= 1.0001 * design.worst_achieved
        # the programme itself is less tight where the interval is many times the line's width
        assert design.bound_programme <= (1.06 if damping > 0.001 else 1.15) * design.worst_achieved
