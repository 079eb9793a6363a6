"""Small studies for the tests."""

import textwrap

import numpy as np
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.studies.grid import Sweep

# cheap to evaluate: turbulence of the model, one integrator
BASE = """
    version: 1
    telescope: {diameter_m: 8.22, obstruction: 0.11}
    sensor: {noise_nm: 15.0}
    loop: {axes: 1, frame_rate_hz: 800.0}
    model:
      turbulence: {kind: ar, coefficients: [0.9886], driving_rms_nm: 89.1}
      vibrations: [{frequency_hz: 20.0, damping: 0.01, rms_nm: 500.0}]
    truth:
      vibrations: [{kind: sinusoid, frequency_hz: 20.0, rms_nm: 500.0}]
    simulation: {frames: 400, cases: 1, settle_frames: 100}
"""
STUDY = {
    "version": "1",
    "config": "base.yaml",
    "samples": "16",
    "seed": "3",
    "controllers": "{slow: {design: integrator, gain: 0.3}}",
    "parameters": "{'truth.vibrations[0].rms_nm': {uniform: [100, 900]}}",
}


def study_file(folder, *, base=BASE, **changes):
    """Write a study and its configuration; changes replace keys, None leaves one out."""
    (folder / "base.yaml").write_text(textwrap.dedent(base))
    lines = [f"{k}: {v}" for k, v in {**STUDY, **changes}.items() if v is not None]
    path = folder / "study.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def load_small_study(folder, **changes):
    return lbt.studies.load_study(study_file(folder, **changes))


LBT_TEXT = LBT_YAML.read_text()
TWO = "{a: {design: kalman}, b: {design: integrator, gain: 0.4}}"


def evaluate_quickly(study, values, start):
    """Columns that tell which row they are of."""
    rows = start + np.arange(len(values))
    columns = {name: rows + values[:, 0] / 7 + i for i, name in enumerate(study.result_columns)}
    return columns, []


def part_rows(folder):
    """The rows of each part in the directory of a study."""
    return list(Sweep(folder=folder / "parts", columns=(), rows=0, digest="").paths())


def make_folder(tmp_path, name="out"):
    folder = tmp_path / name
    folder.mkdir()
    return folder


def read_table(path):
    with path.open() as stream:
        names = stream.readline().rstrip("\n").split(",")
        content = np.loadtxt(stream, delimiter=",", ndmin=2)
    return dict(zip(names, content.T, strict=True))


def assert_whole(folder, study, evaluate=evaluate_quickly):
    """Every row is there once, in order, with what the evaluation says."""
    found = read_table(folder / "results.csv")
    assert tuple(found) == study.columns
    np.testing.assert_array_equal(found["row"], np.arange(study.samples))
    values = study.values()
    for name, column in zip(study.parameter_names, values.T, strict=True):
        np.testing.assert_allclose(found[name], column, rtol=1e-11)
    expected, _ = evaluate(study, values, 0)
    for name in study.result_columns:
        # which samples are in a batch moves what is below the accuracy of the evaluation
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6, err_msg=name)
    assert sum(stop - start for start, stop in part_rows(folder)) == study.samples
    assert {path.stem for path in folder.glob("*.fits")} == set(study.designed)
