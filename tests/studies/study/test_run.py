"""Studies that run, resume and are replayed; samples one by one, and at once against that."""

from dataclasses import replace

import numpy as np
import pytest
from support.configs import numbers_of
from support.plants import LBT_YAML
from support.studies import (
    BASE,
    LBT_TEXT,
    TWO,
    assert_whole,
    evaluate_quickly,
    load_small_study,
    make_folder,
    part_rows,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.studies.study import run as evaluation
from lbt_synth.studies.study.run import evaluate_row, evaluate_samples, replay_row
from lbt_synth.studies.study.study import make_sample


def test_a_run_and_its_results(tmp_path):
    study, counts = load_small_study(tmp_path, controllers=TWO), []
    folder = make_folder(tmp_path)
    first = lbt.studies.run_study(study, folder, progress=counts.append)
    assert (first.computed, first.failures, first.new) == (16, (), True)
    assert sum(counts) == 16
    assert_whole(folder, study, evaluate_samples)
    assert (folder / "failed.csv").read_text() == "row,controller,error\n"
    assert lbt.load_gain(folder / "a.fits").method == "kalman"
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    again = lbt.studies.run_study(study, folder, evaluate=None, progress=counts.append)
    assert (again.computed, sum(counts), again.new) == (0, 32, False)
    assert again.computing_s == first.computing_s > 0
    assert again.columns.keys() == first.columns.keys()
    for name, column in first.columns.items():
        np.testing.assert_array_equal(again.columns[name], column)
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before


def test_failures_are_listed_and_their_rows_are_there(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="8",
        controllers="{a: {design: integrator, gain: 0.3}, "
        "tight: {design: integrator, gain: 0.7, for: sample}}",
        parameters="{loop.delay_frames: {list: [2, 4]}}",
    )
    folder = make_folder(tmp_path)
    run = lbt.studies.run_study(study, folder)
    assert_whole(folder, study, evaluate_samples)
    noisy = np.flatnonzero(run.columns["loop.delay_frames"] == 4)
    lines = (folder / "failed.csv").read_text().splitlines()[1:]
    assert [line.split(",")[:2] for line in lines] == [[str(row), "tight"] for row in noisy]
    assert all("failed its certificate" in line for line in lines)
    assert [failure[:2] for failure in run.failures] == [(row, "tight") for row in noisy]
    assert np.all(np.isnan(run.columns["tight.strehl"][noisy]))
    assert not np.any(np.isnan(run.columns["a.strehl"]))


def test_tables_are_written_from_the_parts(tmp_path):
    """A table that was changed is not read, and one that was deleted is written again."""
    study, folder = load_small_study(tmp_path), make_folder(tmp_path)
    first = lbt.studies.run_study(study, folder, evaluate=evaluate_quickly)
    content = (folder / "results.csv").read_bytes()
    (folder / "results.csv").write_bytes(content[:100])
    again = lbt.studies.run_study(study, folder, evaluate=None)
    np.testing.assert_array_equal(again.columns["slow.strehl"], first.columns["slow.strehl"])
    stored = replay_row(study, folder, 9).stored
    assert stored["slow.strehl"] == first.columns["slow.strehl"][9]
    assert (folder / "results.csv").read_bytes() == content[:100]
    for name in ("results.csv", "failed.csv"):
        (folder / name).unlink()
        again = lbt.studies.run_study(study, folder, evaluate=None)
        assert (again.computed, again.new) == (0, True)
    assert (folder / "results.csv").read_bytes() == content
    min((folder / "parts").glob("*.npz")).unlink()
    again = lbt.studies.run_study(study, folder, evaluate=evaluate_quickly)
    assert again.computed == 4
    assert_whole(folder, study)


def test_a_row_is_replayed(tmp_path):
    base = LBT_TEXT.replace("kind: ar1", "kind: ar2").replace(
        "turbulence: frozen_flow", "turbulence: model"
    )
    study = load_small_study(
        tmp_path,
        base=base,
        samples="4",
        controllers="{a: {design: integrator, gain: 0.4}, own: {design: kalman, for: sample}}",
        parameters="{atmosphere.seeing_arcsec: {uniform: [0.6, 1]}, error.delay_frames: {uniform: "
        "[0.1, 0.3]}, error.noise_factor: {uniform: [1.2, 1.6]}, truth.sensor_gain: 0.8}",
    )
    folder = make_folder(tmp_path)
    lbt.studies.run_study(study, folder)
    again = replay_row(study, folder, 2)
    assert [path.name for path in again.files] == ["row_2.yaml", "row_2_own.fits"]
    assert set(again.fresh) == set(again.stored) == set(study.result_columns)
    for name, value in again.stored.items():
        assert again.fresh[name] == pytest.approx(value, rel=1e-6)
    real = lbt.load_config(folder / "row_2.yaml")
    parameters = study.parameters_by_name(study.values(2, 3)[0])
    assert real.hardware.delay_frames == 2 + parameters["error.delay_frames"]
    text = (folder / "row_2.yaml").read_text()
    assert "designs assume 2 (error.delay_frames)" in text
    assert "(error.noise_factor)" in text
    for name, path in (("a", folder / "a.fits"), ("own", folder / "row_2_own.fits")):
        design = lbt.load_gain(path)
        loop = lbt.close_loop(real.hardware, design.controller, sensor_gain=real.truth.sensor_gain)
        found = lbt.strehl(lbt.residual_budget(loop, real.truth), real.imaging)
        assert found == pytest.approx(again.fresh[f"{name}.strehl"], rel=1e-9)


def test_a_row_of_an_unfinished_study(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "_ROWS_TOGETHER", 7)
    study, folder = load_small_study(tmp_path, samples="60"), make_folder(tmp_path)
    assert replay_row(study, folder, 3).stored == {}

    def stops(study, values, start):
        if start >= 40:
            raise KeyboardInterrupt
        return evaluate_quickly(study, values, start)

    with pytest.raises(KeyboardInterrupt):
        lbt.studies.run_study(study, folder, evaluate=stops)
    last = part_rows(folder)[-1][1] - 1
    stored = replay_row(study, folder, last).stored
    values = study.values(last, last + 1)
    assert stored["slow.strehl"] == evaluate_quickly(study, values, last)[0]["slow.strehl"][0]
    assert replay_row(study, folder, 59).stored == {}
    with pytest.raises(ProblemError, match="rows 0 to 59; got row 60"):
        replay_row(study, folder, 60)


def test_a_sample_is_a_configuration(tmp_path):
    text = LBT_TEXT.replace("sensor_gain: 1.0", "sensor_gain: 0.8")
    study = load_small_study(
        tmp_path,
        base=text,
        parameters="{atmosphere.seeing_arcsec: {list: [0.5, 1.1]}, imaging.wavelength_um: 1.65, "
        "sensor.pyramid.subapertures_across: {list: [20, 30]}, 'robustness.errors_hz[0]': -4, "
        "'truth.vibrations[0].rms_mas': {uniform: [10, 20], also: ['model.vibrations[0].rms_mas']}, "
        "error.delay_frames: {uniform: [0, 0.5]}, error.noise_factor: {uniform: [1, 2]}}",
    )
    for values in study.values(0, 4):
        named = study.parameters_by_name(values)
        config, hardware, truth = make_sample(study, values)
        settings = config.settings
        assert settings.imaging.wavelength_um == 1.65
        assert settings.robustness.errors_hz[:2] == [-4, -3]
        assert truth.sensor_gain == 0.8
        assert config.hardware.delay_frames == 2.0
        assert hardware.delay_frames == 2.0 + named["error.delay_frames"]
        assert truth.noise_nm == pytest.approx(config.noise_nm * named["error.noise_factor"])
        # the same from a file: the independent way
        content = text
        for old, path in (
            ("seeing_arcsec: 0.8", "atmosphere.seeing_arcsec"),
            ("rms_mas: 80.0", "truth.vibrations[0].rms_mas"),
            ("subapertures_across: 30", "sensor.pyramid.subapertures_across"),
        ):
            content = content.replace(old, f"{old.split()[0]} {named[path]:.17g}")
        (tmp_path / "same.yaml").write_text(content)
        same = lbt.load_config(tmp_path / "same.yaml")
        np.testing.assert_array_equal(same.plant.A, config.plant.A)
        np.testing.assert_array_equal(same.plant.B, config.plant.B)
        assert same.truth.noise_nm == config.truth.noise_nm
    assert study.config.settings.atmosphere.seeing_arcsec == 0.8  # the base is as it was


def test_a_point_is_what_the_library_says(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="4",
        controllers="{fixed: {design: kalman}, own: {design: kalman, for: sample}, "
        "wild: {design: integrator, gain: 0.9}}",
        parameters="{'truth.vibrations[0].frequency_hz': {uniform: [18, 22], also: "
        "['model.vibrations[0].frequency_hz']}, error.delay_frames: {uniform: [0.2, 0.4]}, "
        "error.noise_factor: 1.5, truth.sensor_gain: 0.7}",
    )
    values = study.values()
    columns, failures = evaluate_samples(study, values[1:], 1)
    assert failures == []
    assert tuple(columns) == study.result_columns
    config = study.config
    fixed = lbt.kalman(config.plant)
    for i, (frequency, delay, _, _) in enumerate(values[1:]):
        own = lbt.kalman(retuned_plant(config.plant, frequency - 20.0, hold="rms"))
        hardware = replace(config.hardware, delay_frames=2 + delay)
        moved = replace(config.truth.vibrations[0], frequency_hz=frequency)
        truth = replace(config.truth, vibrations=(moved,), noise_nm=22.5, sensor_gain=0.7)
        for name, design in (("fixed", fixed), ("own", own)):
            loop = lbt.close_loop(hardware, design.controller, sensor_gain=0.7)
            budget = lbt.residual_budget(loop, truth)
            for column in ("residual_nm", "turbulence_nm", "vibration_nm", "noise_nm", "within_nm"):
                expected = getattr(budget, column.replace("residual", "rms"))
                assert columns[f"{name}.{column}"][i] == pytest.approx(expected, rel=1e-9)
            expected = lbt.strehl(budget, config.imaging)
            assert columns[f"{name}.strehl"][i] == pytest.approx(expected, rel=1e-9)
            assert columns[f"{name}.stable"][i] == 1
    assert np.all(columns["own.residual_nm"] < 1.05 * columns["fixed.residual_nm"])


COUNT = 8
NOISE = "error.noise_factor: {uniform: [0.9, 1.1]}"
FIXED = "{slow: {design: integrator, gain: 0.3}, kalman: {design: kalman}}"
OWN = "{own: {design: kalman, for: sample}}"
BOTH = "{kalman: {design: kalman}, own: {design: kalman, for: sample}}"


def one_by_one(study, values, start):
    """Return columns and failures of samples, each evaluated by itself."""
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures = []
    for i, row in enumerate(values):
        with np.errstate(all="ignore"):
            results, failed = evaluate_row(study, row, start + i)
        failures += failed
        for name, value in results.items():
            columns[name][i] = value
    return columns, failures


def agree(tmp_path, *, base, controllers, parameters, count=COUNT, **more):
    """Hold each column against the evaluation one by one; return the columns and failures."""
    sections = {"controllers": controllers, "parameters": parameters}
    study = load_small_study(tmp_path, base=base, **sections, **more)
    values = study.values(0, count)
    columns, failures = evaluate_samples(study, values, 0)
    single, failed = one_by_one(study, values, 0)
    assert columns.keys() == single.keys()
    for name, expected in single.items():
        assert columns[name] == pytest.approx(expected, rel=1e-6, nan_ok=True), name
    assert failures == failed
    return study, columns, failures


WEATHER = """{
  atmosphere.seeing_arcsec: {uniform: [0.5, 1.2]},
  atmosphere.wind_speed_m_s: {list: [10, 20]},
  atmosphere.outer_scale_m: {list: [15, 25]},
  'truth.vibrations[0].frequency_hz': {normal: {mean: 20, deviation: 0.5}},
  'truth.vibrations[0].rms_mas': {uniform: [40, 100], also: ['model.vibrations[0].rms_mas']},
  'model.vibrations[0].damping': {uniform: [0.002, 0.02]},
  sensor.pyramid.photons: {uniform: [20, 100]},
  truth.sensor_gain: {uniform: [0.3, 1.3]},
  error.delay_frames: {uniform: [-0.5, 1.5]},
  error.noise_factor: {uniform: [0.5, 2]}
}"""


def test_filters_for_their_own_samples(tmp_path, monkeypatch):
    own = {"base": LBT_TEXT, "controllers": BOTH, "parameters": WEATHER}
    study, columns, _ = agree(tmp_path, count=6, **own)
    rows, real = [], evaluation.evaluate_row

    def spy(study, values, row):
        rows.append(row)
        return real(study, values, row)

    monkeypatch.setattr(evaluation, "evaluate_row", spy)
    evaluate_samples(study, study.values(0, 6), 0)
    assert rows == [3, 3]  # all of them at once, and one of each controller by itself
    strehl = columns["own.strehl"]
    assert len(np.unique(strehl[~np.isnan(strehl)])) >= 3


LOOP = "truth.sensor_gain: {uniform: [0.4, 1.1]}"
DELAY = "error.delay_frames: {list: [0, 0.25]}"
TIP = "\n    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}"
MIRROR = "mirror:\n  local_loop: {natural_frequency_hz: 50, damping: 0.5, bandwidth_hz: 400}\n"
SPREAD = BASE.replace("rms_nm: 500.0}]", "rms_nm: 500.0, spread_hz: 1.0, lines: 3}]", 1)
SINUSOID = "[{kind: sinusoid, frequency_hz: 20.0, rms_nm: 500.0}]"
CHANGED = {  # a configuration, what is put in place of what, parameters, samples
    "turbulence of kind ar2": (LBT_TEXT, {"kind: ar1": "kind: ar2"}, WEATHER, 5),
    "one axis and the turbulence of the model": (
        BASE,
        {},
        "'truth.vibrations[0].rms_nm': {uniform: [100, 900]}, 'model.vibrations[0].frequency_hz': "
        f"{{uniform: [18, 22]}}, sensor.noise_nm: {{uniform: [5, 30]}}, {LOOP}",
        COUNT,
    ),
    "resonances and vibrations of the model, which both move": (
        LBT_TEXT,
        {TIP: " model"},
        "'model.vibrations[0].frequency_hz': {uniform: [18, 22]}, 'model.vibrations[0].rms_mas': "
        "{uniform: [40, 100]}, 'model.vibrations[0].damping': {uniform: [0.002, 0.02]}, " + DELAY,
        5,
    ),
    "vibrations of the model that are several lines": (
        SPREAD,
        {SINUSOID: "model"},
        f"sensor.noise_nm: {{uniform: [5, 30]}}, {LOOP}",
        5,
    ),
    "a mirror with dynamics": (LBT_TEXT, {"mirror:\n": MIRROR}, f"{LOOP}, {DELAY}", 5),
    "a diagonal vibration, without a filter per axis": (
        LBT_TEXT,
        {"axis: tip,": "direction_deg: 30,", "axis: both,": "direction_deg: 30,"},
        "'truth.vibrations[0].frequency_hz': {uniform: [19, 21]}",
        4,
    ),
    "the delay that designs assume": (
        LBT_TEXT,
        {},
        "loop.delay_frames: {list: [1, 2, 2.5]}, truth.sensor_gain: {uniform: [0.4, 1]}",
        6,
    ),
}


@pytest.mark.parametrize("name", CHANGED)
def test_changed_configurations(tmp_path, name):
    base, changes, parameters, count = CHANGED[name]
    for old, new in changes.items():
        assert old in base
        base = base.replace(old, new)
    parameters = parameters if parameters is WEATHER else f"{{{parameters}}}"
    agree(tmp_path, base=base, controllers=BOTH, parameters=parameters, count=count)


def test_samples_that_the_configuration_refuses(tmp_path):
    """A tail of the normal distribution below 0: those fail as they do on their own."""
    parameters = """{
      'truth.vibrations[0].rms_nm': {normal: {mean: 300, deviation: 100, high: 900}},
      truth.sensor_gain: {normal: {mean: 0.8, deviation: 0.1, low: 0.5}}
    }"""
    study = load_small_study(tmp_path, controllers=FIXED, parameters=parameters)
    values = study.values(0, COUNT)
    values[2, 0] = -5.0
    values[4, 1] = 0.0
    columns, failures = evaluate_samples(study, values, 100)
    _, failed = one_by_one(study, values, 100)
    lost = [(row, name) for row in (102, 104) for name in ("slow", "kalman")]
    assert [failure[:2] for failure in failures] == lost
    assert "greater than" in failures[0][2]
    assert failures == failed
    assert np.flatnonzero(np.isnan(columns["slow.stable"])).tolist() == [2, 4]


def test_a_filter_that_cannot_be_designed(tmp_path):
    """The others of its batch are designed all the same."""
    parameters = """{
      sensor.noise_nm: {uniform: [5, 30]},
      'model.vibrations[0].rms_nm': {uniform: [100, 900]}
    }"""
    study = load_small_study(tmp_path, controllers=OWN, parameters=parameters)
    values = study.values(0, COUNT)
    values[3, 1] = 1e170  # its variance overflows
    columns, failures = evaluate_samples(study, values, 0)
    assert {row for row, _, _ in failures} == {3}
    assert np.isfinite(columns["own.strehl"]).sum() == COUNT - 1


UNREAD = ("version", "design", "simulation", "robustness", "end_to_end")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        number
        for number in numbers_of(lbt.load_config(LBT_YAML).settings.model_dump())
        if not number[0].startswith(UNREAD) and number[0] != "loop.frame_rate_hz"
    ],
)
def test_every_number_of_a_configuration(tmp_path, path, value):
    """Whether it is one value for all or an array, the answers are those of each by itself."""
    other = value + 1 if isinstance(value, int) else 0.96 * value
    agree(
        tmp_path,
        base=LBT_TEXT,
        controllers=OWN,
        parameters=f"{{'{path}': {{list: [{value!r}, {other!r}]}}, {NOISE}}}",
        count=2,
    )


def test_two_answers_stop_a_study(tmp_path, monkeypatch):
    study = load_small_study(
        tmp_path, controllers=FIXED, parameters="{truth.sensor_gain: {uniform: [0.4, 1]}}"
    )
    real = evaluation.ensemble_columns

    def wrong(*loops):
        columns = real(*loops)
        return {**columns, "noise_nm": 1.001 * columns["noise_nm"]}

    monkeypatch.setattr(evaluation, "ensemble_columns", wrong)
    with pytest.raises(lbt.errors.CertificateError, match="row 14 has slow.*by itself"):
        evaluate_samples(study, study.values(10, 16)[:8], 11)
