"""A design from a record, and what is noted against it.

The method that a record asks for, and when the default one stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.night import GAIN, night_record
from support.recorded_loops import LINE, RATE, spliced_record

import lbt_synth as lbt
from lbt_synth.identification.auto import choose_method, note_drift, quick_methods
from lbt_synth.identification.prediction.residual import estimate_residual
from lbt_synth.methods import registry
from lbt_synth.methods.registry import default_method, method_named

DRIFT_HZ = 500.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=DRIFT_HZ)


def test_a_design_is_doubted_where_the_gains_disagree() -> None:
    first = spliced_record((0,), lines=LINE, frames=20_000, sensor_gain=0.9)
    second = spliced_record((1,), lines=LINE, frames=12_000, sensor_gain=0.4)
    both = lbt.identification.loop_record(
        np.vstack([first.measurements[:12_000], second.measurements]),
        np.vstack([first.commands[:12_000], second.commands]),
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    try:
        notes = lbt.design_from_record(both).notes
    except lbt.errors.CertificateError as error:
        notes = (str(error),)
    assert any("sensor gain" in note for note in notes)
    given = lbt.design_from_record(first, method="hinf")
    assert (given.notes, given.name) == ((), "H-infinity filter")


def test_a_design_needs_a_delay_and_data():
    noise = np.random.default_rng(0).standard_normal((9000, 1))
    with pytest.raises(
        lbt.errors.ProblemError, match="delay of this loop is not known; give delay_frames"
    ):
        lbt.design_from_record(
            lbt.identification.loop_record(noise, noise, frame_rate_hz=RATE, unit="nm")
        )
    with pytest.raises(lbt.errors.ProblemError, match="LoopRecord"):
        lbt.design_from_record(noise)
    short = lbt.identification.loop_record(
        noise[:900], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 4000 usable frames \(4 s at 1000 Hz\).*got 900 \(0.9"
    ):
        lbt.design_from_record(short)
    with pytest.raises(lbt.errors.ProblemError, match="method"):
        lbt.design_from_record(short, method="magic")


def drifting_record(offset_nm: float, speed_nm_s: float) -> lbt.identification.LoopRecord:
    """A record of noise whose commands move, on the second axis; its sensor gain is 0.5."""
    noise = np.random.default_rng(0).standard_normal((5000, 2))
    commands = np.zeros((5000, 2))
    commands[:, 1] = offset_nm + speed_nm_s * (np.arange(5000) - 2500) / DRIFT_HZ
    return lbt.identification.loop_record(
        noise, commands, frame_rate_hz=DRIFT_HZ, delay_frames=2, unit="nm"
    )


def test_what_a_filter_leaves_of_a_drift_is_noted():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=DRIFT_HZ, turbulence=SLOW, noise_nm=5.0, sensor_gain=0.5
    )
    controller = lbt.kalman(plant).controller
    left = abs(lbt.close_loop(plant.hardware, controller).sensitivity([1e-6])[0, 1, 1])
    assert 0.01 < left < 0.5
    assert list(note_drift(drifting_record(10.0, 1.0), plant, controller)) == []
    (note,) = note_drift(drifting_record(3000.0, -200.0), plant, controller)
    assert note.startswith("axis 1 of the record stands 3e+03 nm off zero and drifts by -200 nm/s.")
    said = float(note.split("leaves up to ")[1].split(" nm")[0])
    assert said == pytest.approx(left * (3000 + 5 * 200), rel=0.05)


def residuals(*, error, **differences):
    """Residuals of methods, whose variances are below 1000 by differences on three parts."""
    parts = {"kalman": [], **{name: [] for name in differences}}
    for i in range(3):
        common, own = np.random.default_rng(i).standard_normal((2, 6000))
        common *= np.sqrt(1000 / np.mean(common**2))
        own -= common * (common @ own) / (common @ common)
        # its product with the common part scatters
        size = 6000 * error**2 / 4000
        own *= np.sqrt(size / np.mean(own**2))
        parts["kalman"].append(common)
        for name, less in differences.items():
            parts[name].append(np.sqrt(1 - (less[i] + size) / 1000) * common + own)
    zero = np.zeros((1, 1))
    return {
        name: estimate_residual(np.concatenate(series)[:, None], ((5, 18_005),), zero, zero)
        for name, series in parts.items()
    }


@pytest.mark.parametrize(
    ("differences", "error", "chosen"),
    [
        ((40.0, 40.0, 40.0), 4.0, "hinf"),
        ((400.0, 400.0, 10.0), 1.0, "kalman"),  # less than 2 % of the variance on one part
        ((400.0, 400.0, -20.0), 1.0, "kalman"),  # more on one
        ((25.0, 25.0, 25.0), 20.0, "kalman"),  # within two errors
        ((-20.0, -20.0, -20.0), 1.0, "kalman"),
    ],
)
def test_the_default_stays_unless_another_wins_every_part(differences, error, chosen):
    compared = residuals(error=error, hinf=differences)
    pairs = zip(*(compared[name].parts(3) for name in ("kalman", "hinf")), strict=True)
    for (usual, other), difference in zip(pairs, differences, strict=True):
        above, its_error = usual.above(other)
        assert above == pytest.approx(difference)
        assert its_error == pytest.approx(error, rel=0.3) or difference >= 400
    method, (note,) = choose_method(compared)
    assert method == chosen
    words = "H-infinity filter is chosen" if chosen == "hinf" else "Kalman filter stays"
    assert f"the {words}" in note
    assert not note.endswith(".")  # whoever prints it ends it


def test_a_method_that_leaves_clearly_less_says_by_how_much():
    compared = residuals(error=4.0, hinf=(100.0, 200.0, 300.0))
    difference, error = compared["kalman"].above(compared["hinf"])
    _, (note,) = choose_method(compared)
    assert note.endswith(f"less than the Kalman filter, in all by 200 +- {error:.2g} nm^2")
    assert difference == pytest.approx(200)


def test_a_method_that_a_possible_gain_makes_unstable_is_not_chosen():
    compared = residuals(error=4.0, hinf=(200.0,) * 3, lqg=(100.0,) * 3)
    method, notes = choose_method(compared, {"hinf"})
    assert method == "lqg"
    assert "H-infinity filter is left out: its loop is unstable" in notes[1]


def test_without_the_default_the_best_is_chosen():
    compared = residuals(error=4.0, hinf=(-200.0,) * 3, lqg=(-100.0,) * 3)
    del compared["kalman"]
    method, (note,) = choose_method(compared)
    assert method == "lqg"
    assert "of the methods that are left" in note


def test_all_quick_methods_are_in_the_table_of_unseen_data():
    record = night_record()
    made = lbt.design_from_record(record, sensor_gain=GAIN, most_lines=1)
    names = [row.name for row in made.held_out.entries]
    assert {method_named(name).title for name in quick_methods()} < set(names)
    assert (made.name, made.design.method) == ("Kalman filter", "kalman")
    assert any(note.startswith("the Kalman filter stays") for note in made.notes)


def test_slow_methods_are_not_tried(monkeypatch):
    assert default_method() in quick_methods()
    assert not any(method_named(name).slow for name in quick_methods())
    usual = method_named(default_method())
    for slow in (False, True):
        newcomer = replace(usual, name="newcomer", slow=slow)
        monkeypatch.setitem(registry.METHODS, "newcomer", newcomer)
        assert ("newcomer" in quick_methods()) is not slow
