"""Rows of a study again."""

import pytest
from support.studies import (
    LBT_TEXT,
    evaluate_quickly,
    load_small_study,
    make_folder,
    part_rows,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


@pytest.mark.parametrize("evaluation", ["exact", "simulation"])
@pytest.mark.parametrize("turbulence", ["ar1", "ar2"])
def test_a_row_is_replayed(tmp_path, evaluation, turbulence):
    base = LBT_TEXT.replace("kind: ar1", f"kind: {turbulence}").replace(
        "turbulence: frozen_flow", "turbulence: model"
    )
    base = base.replace("frames: 8000", "frames: 300").replace("cases: 4", "cases: 2")
    study = load_small_study(
        tmp_path,
        base=base,
        evaluation=evaluation,
        samples="4",
        controllers="{a: {design: integrator, gain: 0.4}, own: {design: kalman, for: sample}}",
        parameters="{atmosphere.seeing_arcsec: {uniform: [0.6, 1]}, error.delay_frames: {uniform: "
        "[0.1, 0.3]}, error.noise_factor: {uniform: [1.2, 1.6]}, truth.sensor_gain: 0.8}",
    )
    folder = make_folder(tmp_path)
    lbt.studies.run_study(study, folder)
    again = lbt.studies.replay_row(study, folder, 2)
    assert [path.name for path in again.files] == ["row_2.yaml", "row_2_own.fits"]
    assert set(again.fresh) == set(again.stored) == set(study.result_columns)
    for name, value in again.stored.items():
        assert again.fresh[name] == pytest.approx(value, rel=1e-6)
    real = lbt.load_config(folder / "row_2.yaml")
    assert real.hardware.delay_frames == 2 + again.parameters["error.delay_frames"]
    text = (folder / "row_2.yaml").read_text()
    assert "designs assume 2 (error.delay_frames)" in text
    assert "(error.noise_factor)" in text
    for name, path in (("a", folder / "a.fits"), ("own", folder / "row_2_own.fits")):
        design = lbt.load_gain(path)
        loop = lbt.close_loop(real.hardware, design.controller, sensor_gain=real.truth.sensor_gain)
        if evaluation == "exact":
            found = lbt.strehl(lbt.residual_budget(loop, real.truth), real.imaging)
        else:
            section = real.settings.simulation
            found = (
                lbt.simulate(
                    design.controller,
                    real.truth,
                    hardware=real.hardware,
                    frames=300,
                    cases=2,
                    seed=section.seed,
                    settle_frames=section.settle_frames,
                )
                .strehl(real.imaging)
                .mean()
            )
        assert found == pytest.approx(again.fresh[f"{name}.strehl"], rel=1e-9)


@pytest.mark.usefixtures("small_parts")
def test_a_row_of_an_unfinished_study(tmp_path):
    study, folder = load_small_study(tmp_path, samples="60"), make_folder(tmp_path)
    assert lbt.studies.replay_row(study, folder, 3).stored == {}

    def stops(study, values, start):
        if start >= 40:
            raise KeyboardInterrupt
        return evaluate_quickly(study, values, start)

    with pytest.raises(KeyboardInterrupt):
        lbt.studies.run_study(study, folder, evaluate=stops)
    last = part_rows(folder)[-1][1] - 1
    stored = lbt.studies.replay_row(study, folder, last).stored
    values = study.values(last, last + 1)
    assert stored["slow.strehl"] == evaluate_quickly(study, values, last)[0]["slow.strehl"][0]
    assert lbt.studies.replay_row(study, folder, 59).stored == {}
    with pytest.raises(ProblemError, match="rows 0 to 59; got row 60"):
        lbt.studies.replay_row(study, folder, 60)


def test_a_row_whose_design_fails(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="2",
        controllers="{tight: {design: integrator, gain: 0.7, for: sample}}",
        parameters="{loop.delay_frames: {list: [4, 5]}}",
    )
    again = lbt.studies.replay_row(study, make_folder(tmp_path), 1)
    assert "failed its certificate" in again.failures[0][2]
    assert [path.name for path in again.files] == ["row_1.yaml"]


def test_a_row_without_noise(tmp_path):
    study, folder = (
        load_small_study(tmp_path, parameters="{error.noise_factor: 0}"),
        make_folder(tmp_path),
    )
    again = lbt.studies.replay_row(study, folder, 1)
    assert again.fresh["slow.noise_nm"] == 0
    assert again.fresh["slow.strehl"] > 0.1
    assert again.files == ()
    assert "row 1 has no noise, which no configuration takes" in again.unwritten
