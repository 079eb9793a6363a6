"""What competes in a league, and that it does not look ahead."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.league import short_record, short_split

import lbt_synth as lbt
from lbt_synth.errors import CertificateError, ProblemError
from lbt_synth.methods import method_named, register, unregister
from lbt_synth.studies.league import entries
from lbt_synth.studies.league.entries import all_entries, choose_entries

LATER = 600  # frames at the end of the test that are changed


@pytest.fixture(scope="module")
def split():
    return short_split()


@pytest.mark.parametrize(
    "name",
    ["optimised-gain", "least-squares-32", "data-driven-2", "kalman", "robust", "auto"],
)
def test_an_entry_does_not_look_ahead(split, name, monkeypatch):
    monkeypatch.setattr(entries, "_ORDERS", (2,))
    entry = all_entries()[name]
    ((_, stop),) = split.test
    z = split.open_loop.copy()
    z[stop - LATER : stop] += 300.0
    once, again = entry.residual(split), entry.residual(replace(split, open_loop=z))
    assert once.shape == split.measured().shape
    assert np.array_equal(once[:-LATER], again[:-LATER])
    assert np.max(np.abs(once[-LATER:] - again[-LATER:])) > 100
    # it learned something: an integrator leaves more
    assert np.mean(once**2) <= np.mean(all_entries()["optimised-gain"].residual(split) ** 2)


def test_what_ran_is_what_was_measured(split):
    assert np.array_equal(all_entries()["ran"].residual(split), split.measured())
    open_loop = replace(split, record=short_record(closed=False))
    with pytest.raises(ProblemError, match="nothing ran"):
        all_entries()["ran"].residual(open_loop)


def test_a_new_method_joins_without_a_change_here():
    copy = replace(method_named("kalman"), name="newcomer", title="new filter")
    register(copy)
    try:
        assert all_entries()["newcomer"].title == "new filter"
    finally:
        unregister("newcomer")
    assert "newcomer" not in all_entries()


def test_without_pyrtc_its_rows_say_so(monkeypatch, split):
    monkeypatch.setattr(entries, "pyrtc_version", lambda: None)
    missing = {name: entry.missing for name, entry in all_entries().items() if entry.missing}
    assert list(missing) == ["pyrtc-ar-kalman", "pyrtc-least-squares"]
    assert missing["pyrtc-ar-kalman"] == 'not installed; try: pip install "lbt-synth[pyrtc]"'


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["pyrtc-ar-kalman", "pyrtc-least-squares"])
def test_the_predictors_of_pyrtc_run(split, name):
    pytest.importorskip("pyrtc")
    left = all_entries()[name].residual(split)
    ran = split.measured()
    assert left.shape == ran.shape
    assert np.mean(left**2) < 0.9 * np.mean(ran**2)


def test_entries_are_chosen_by_name():
    assert list(choose_entries(["kalman", "ran"])) == ["ran", "kalman"]
    assert list(choose_entries(None)) == list(all_entries())
    with pytest.raises(ProblemError, match="must be one of ran, best-integrator, .* got 'magic'"):
        choose_entries(["magic"])


def test_the_tracking_controller_is_a_loop_frame_by_frame(split, monkeypatch):
    """From two windows before the test on, it begins with the automatic design's plant."""
    model = replace(split.model, axes=(replace(split.model.axes[0], noise_nm=7.0),))
    made = SimpleNamespace(model=model)
    monkeypatch.setattr(entries, "design_from_record", lambda *_given, **_options: made)
    start, past = split.test[0][0], 4000
    identifier = lbt.identification.LoopIdentifier(model.plant(), find_gain=False)
    tracker = lbt.identification.TrackingController(model.plant(), identifier, window_s=4.0)
    left, commands = [], [np.zeros(1), np.zeros(1)]
    for open_loop in split.open_loop[start - past : split.test[0][1]]:
        left.append(open_loop - commands[-2])
        commands.append(tracker.step(np.array(split.model.sensor_gains) * left[-1]))
    expected = np.array(left)[past:]
    found = all_entries()["tracking"].residual(replace(split))
    assert found == pytest.approx(expected, abs=1e-9)


def test_without_an_automatic_design_tracking_begins_with_the_model(split, monkeypatch):
    begun = []

    def refuse(*_given, **_options):
        raise CertificateError("not at all gains")

    def begin(plant, *_given, **_options):
        begun.append(plant)
        raise ProblemError("seen enough")

    monkeypatch.setattr(entries, "design_from_record", refuse)
    monkeypatch.setattr(entries, "TrackingController", begin)
    with pytest.raises(ProblemError, match="seen enough"):
        all_entries()["tracking"].residual(replace(split))
    assert np.array_equal(begun[0].A, split.model.plant().A)
