"""Runs of studies: what they write, resume and refuse."""

import numpy as np
import pytest
from support.studies import (
    LBT_TEXT,
    TWO,
    assert_whole,
    evaluate_quickly,
    load_small_study,
    make_folder,
    part_rows,
    read_table,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.studies.study.run import replay_row
from lbt_synth.studies.study.sample import evaluate_samples


def part_path(folder, place):
    return sorted((folder / "parts").glob("*.npz"))[place]


def test_a_run_and_its_results(tmp_path):
    study, folder, counts = (
        load_small_study(tmp_path, samples="50", controllers=TWO),
        make_folder(tmp_path),
        [],
    )
    run = lbt.studies.run_study(study, folder, progress=counts.append)
    assert (run.computed, run.failures, run.new) == (50, (), True)
    np.testing.assert_array_equal(run.columns["row"], np.arange(50))
    assert sum(counts) == 50
    assert_whole(folder, study, evaluate_samples)
    assert (folder / "failed.csv").read_text() == "row,controller,error\n"
    assert lbt.load_gain(folder / "a.fits").method == "kalman"
    text = (folder / "results.csv").read_text()
    assert text.splitlines()[0] == ",".join(study.columns)
    assert text.splitlines()[7].startswith("6,")


def test_a_finished_study_is_not_run_again(tmp_path):
    study, folder, counts = load_small_study(tmp_path), make_folder(tmp_path), []
    first = lbt.studies.run_study(study, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    again = lbt.studies.run_study(study, folder, evaluate=None, progress=counts.append)
    assert (again.computed, sum(counts), again.new) == (0, 16, False)
    assert again.computing_s == first.computing_s > 0
    assert again.columns.keys() == first.columns.keys()
    for name, column in first.columns.items():
        np.testing.assert_array_equal(again.columns[name], column)
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before


def test_failures_are_listed_and_their_rows_are_there(tmp_path):
    study = load_small_study(
        tmp_path,
        samples="8",
        controllers="{a: {design: integrator, gain: 0.3}, tight: {design: integrator, gain: 0.7, "
        "for: sample}}",
        parameters="{loop.delay_frames: {list: [2, 4]}}",
    )
    folder = make_folder(tmp_path)
    run = lbt.studies.run_study(study, folder)
    found = read_table(folder / "results.csv")
    assert_whole(folder, study, evaluate_samples)
    noisy = np.flatnonzero(found["loop.delay_frames"] == 4)
    lines = (folder / "failed.csv").read_text().splitlines()[1:]
    assert [line.split(",")[:2] for line in lines] == [[str(row), "tight"] for row in noisy]
    assert all("failed its certificate" in line for line in lines)
    assert [failure[:2] for failure in run.failures] == [(row, "tight") for row in noisy]
    assert np.all(np.isnan(found["tight.strehl"][noisy]))
    assert not np.any(np.isnan(found["a.strehl"]))


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
    part_path(folder, 0).unlink()
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


@pytest.mark.usefixtures("small_parts")
def test_a_row_of_an_unfinished_study(tmp_path):
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
