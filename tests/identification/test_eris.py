"""The example on the vibration spectrum of VLT/ERIS."""

from __future__ import annotations

import hashlib
import importlib.util
from types import ModuleType

import numpy as np
import pytest
from support.plants import ROOT

import lbt_synth as lbt

FILE = ROOT / "examples" / "data" / "eris_vibrations_psd.fits"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "eris_vibrations", ROOT / "examples" / "eris_vibrations.py"
    )
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["eris_vibrations"] = module  # its dataclass looks there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def seen(example) -> lbt.identification.SpectrumRecord:
    return example.record()


@pytest.fixture(scope="module")
def model(seen) -> lbt.identification.IdentifiedModel:
    return lbt.identify(seen, frame_rate_hz=1000, delay_frames=2)


def test_data_come_unchanged_with_their_licence():
    readme = (FILE.parent / "README.md").read_text("utf-8")
    assert hashlib.sha256(FILE.read_bytes()).hexdigest() in readme
    licence = (FILE.parent / "LICENSE.astro-tiptop").read_text("utf-8")
    assert "Copyright (c) 2021 FabioRossiArcetri" in licence
    assert "The above copyright notice and this permission notice shall be included" in licence


def test_file_without_names_is_read_as_a_spectrum():
    found = lbt.load_record(FILE, kind="spectrum", unit="nm^2/Hz")
    assert (found.axes, found.frequency_hz.size, found.averages) == (2, 3393, None)
    assert found.rms_nm == pytest.approx([94.6, 101.5], abs=0.05)
    by_number = lbt.load_record(FILE, unit="nm^2/Hz", columns={"frequency": 0, "density": (1, 2)})
    assert np.array_equal(by_number.density_nm2_hz, found.density_nm2_hz)
    with pytest.raises(lbt.errors.ProblemError, match=r"unit of the density; give unit \(nm\^2/Hz"):
        lbt.load_record(FILE, kind="spectrum")
    with pytest.raises(lbt.errors.ProblemError, match="say what kind"):
        lbt.load_record(FILE)


def test_background_of_the_file_is_a_formula(seen, example):
    formula = example.BACKGROUND_NM2_HZ / seen.frequency_hz**2
    same = np.abs(seen.density_nm2_hz / formula[:, None] - 1) < 1e-6
    assert np.all(same.mean(axis=0) > 0.97)
    assert same.all(axis=1).mean() == pytest.approx(0.963, abs=0.001)


def test_spectrum_without_scatter_is_taken_for_one_periodogram(example):
    plain = lbt.load_record(FILE, kind="spectrum", unit="nm^2/Hz")
    found = lbt.identify(plain, frame_rate_hz=1000)
    assert len(found.notes) == 2
    assert all("does not scatter" in note for note in found.notes)
    for column, axis in zip(plain.density_nm2_hz.T, found.axes, strict=True):
        assert axis.data.count[0] == 1
        assert len(axis.lines) >= 8
        peaks = np.array(example.peaks(plain.frequency_hz, column))[:, 0]
        assert all(np.min(np.abs(peaks - line.frequency_hz)) < 0.06 for line in axis.lines)
        assert all(line.rms_nm < 30 for line in axis.lines)  # 332 where it counts as a million


def test_known_lines_are_found(model):
    for axis, known in zip(
        model.axes,
        ([10, 16, 25.8, 45.5, 48.3, 96.7], [10, 16, 45.5, 48.3, 72.5, 96.7]),
        strict=True,
    ):
        places = np.array([line.frequency_hz for line in axis.lines])
        for frequency in known:
            assert np.min(np.abs(places - frequency)) < 0.06
    assert not model.notes


def test_identified_rms_are_those_of_the_bins(model, seen, example):
    strong = 0
    for i, axis in enumerate(model.axes):
        peaks = np.array(example.peaks(seen.frequency_hz, seen.density_nm2_hz[:, i]))
        for line in axis.lines:
            near = peaks[np.abs(peaks[:, 0] - line.frequency_hz) < 0.08]
            size = np.sqrt(np.sum(near[:, 1] ** 2))
            assert size > 0  # none is where the file has nothing
            assert 0.4 * size < line.rms_nm < 1.4 * size
            assert 0 < line.rms_error_nm < line.rms_nm
            strong += abs(line.rms_nm - size) < 2 * line.rms_error_nm
    assert strong >= 17  # of 22


def test_parts_of_the_disturbance_are_the_file(seen, example):
    met = example.disturbance(seen)
    f = np.concatenate([seen.frequency_hz, seen.frequency_hz[:-1] + 0.009])
    for i, column in enumerate(seen.spectra):
        whole = lbt.models.SumSpectrum(parts=[met.background[i], met.lines[i]])
        assert whole.psd(f) == pytest.approx(column.psd(f), rel=1e-12)
        moved = example.disturbance(seen, shift_hz=0.5).lines[i]
        assert moved.psd(f + 0.5) == pytest.approx(met.lines[i].psd(f), rel=1e-9, abs=1e-9)


def test_kalman_removes_what_the_integrator_leaves_of_the_lines(model, seen, example):
    met, plant = example.disturbance(seen), example.composed(model)
    lines = {}
    for name, design in {
        "integrator": lbt.design.model_integrator(plant),
        "Kalman": lbt.kalman(plant),
    }.items():
        assert design.certificate.passed
        loop = lbt.close_loop(plant.hardware, design.controller)
        parts = example.residual(loop, met)
        lines[name] = example.rms(parts["lines"])
        # bin by bin, without quadrature
        f, step = seen.frequency_hz, np.median(np.diff(seen.frequency_hz))
        excess = np.array([part.psd(f) for part in met.lines]).T
        power = np.einsum("fij,fj->", np.abs(loop.sensitivity(f)) ** 2, excess) * step
        assert lines[name] == pytest.approx(np.sqrt(power), rel=0.15)
        assert example.rms(parts["total"]) ** 2 == pytest.approx(
            sum(example.rms(parts[key]) ** 2 for key in parts if key != "total")
        )
        limit = lbt.loop.least_residual(plant.hardware, met.whole)
        assert limit.rms_nm < example.rms(parts["total"])
    assert lines["Kalman"] < 0.3 * lines["integrator"]


def test_turbulence_of_the_plant_is_the_atmospheres(model, example):
    plant = example.composed(model)
    air = lbt.models.ar2_turbulence(example.AIR, frame_rate_hz=1000, noise_nm=example.NOISE_NM)
    made = plant.vibrations[0].ar_model(1000)
    assert made.coefficients == pytest.approx(air.coefficients, rel=1e-9)
    assert made.rms_nm == pytest.approx(air.rms_nm, rel=1e-9)


def test_figure_of_a_short_spectrum(model):
    figure = lbt.report.figures.identification_figure(model)
    figure.canvas.draw()
    labels = [text.get_text() for text in figure.axes[4].get_xticklabels() if text.get_text()]
    assert {"10", "20", "50"} <= set(labels)
    for plot, axis in zip(figure.axes[:2], model.axes, strict=True):
        assert len(plot.texts) == len(axis.lines)
        edges = plot.get_window_extent()
        blended = plot.get_xaxis_transform()
        places = [blended.transform(text.get_position())[0] for text in plot.texts]
        # 6.5 points of type, and a little more
        assert np.all(np.diff(places) > 1.1 * 6.5 / 72 * figure.dpi)
        highest = np.max(
            np.interp([x.frequency_hz for x in axis.lines], axis.frequency_hz, axis.fitted_nm2_hz)
        )
        top = plot.transData.transform((10, highest))[1]
        for text in plot.texts:
            x, y = blended.transform(text.get_position())
            assert edges.x0 < x < edges.x1
            assert y > top
