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
from lbt_synth.errors import CertificateError
from lbt_synth.identification import auto
from lbt_synth.identification.auto import choose_method, note_drift, quick_methods
from lbt_synth.identification.prediction.residual import estimate_residual, replayed_residual
from lbt_synth.identification.stretches import forward_splits
from lbt_synth.methods import method_named, registry
from lbt_synth.methods.registry import default_method

DRIFT_HZ = 500.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=DRIFT_HZ)
KNOWN = {"sensor_gain": GAIN, "most_lines": 1}


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
    assert (given.notes, given.choice, given.name) == ((), None, "H-infinity filter")


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
        lbt.errors.ProblemError, match=r"needs 8000 usable frames \(8 s at 1000 Hz\).*got 900 \(0.9"
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


@pytest.fixture(scope="module")
def record():
    return night_record()


@pytest.fixture(scope="module")
def models(record):
    """Models of the first half, two thirds and five sixths."""
    return [lbt.identify(record, stretches=training, **KNOWN) for training, _ in splits(record)]


def splits(record):
    return forward_splits(record.stretches(), record.frames, splits=3)


def worse(plant):
    """An integrator."""
    return lbt.integrator(plant.hardware, gain=0.3)


def choose(record, models, designs, *, is_safe=lambda _: True):
    """Choose among methods that stand for other designs; return what was identified, too."""
    asked = []

    def identify_past(**given):
        asked.append(given)
        return models[len(asked)]

    def design(name, model, _options):
        if name not in designs:
            raise CertificateError("it was not asked for.")
        return designs[name](model.plant())

    found = choose_method(
        record, models[0], identify_past=identify_past, design=design, is_safe=is_safe
    )
    return found, asked


def test_a_method_that_leaves_clearly_less_is_chosen(record, models):
    found, asked = choose(record, models, {"kalman": worse, "hinf": lbt.kalman})
    assert found.method == "hinf"
    assert [row.name for row in found.rows] == ["H-infinity filter", "Kalman filter"]
    # the first half is not identified again
    starts = zip(splits(record)[1:], models, strict=False)
    assert asked == [{"stretches": pair[0], "start": model} for pair, model in starts]
    bad, good = (
        np.mean(
            [
                replayed_residual(
                    record.pseudo_open_loop(model.sensor_gains),
                    make(model.plant()).controller,
                    model.hardware,
                    noise_nm=[axis.noise_nm for axis in model.axes],
                    stretches=record.stretches(),
                    test=test,
                ).measured_nm2
                for (_, test), model in zip(splits(record), models, strict=True)
            ]
        )
        for make in (worse, lbt.kalman)
    )
    assert found.rows[1].above_nm2 == pytest.approx(bad - good)
    assert found.rows[1].above == pytest.approx((bad - good) / good)
    assert found.rows[1].above_nm2 > 2 * found.rows[1].above_error_nm2
    assert (found.rows[0].above_nm2, found.rows[0].above_error_nm2) == (0, 0)
    assert "H-infinity filter is chosen" in found.notes[0]
    assert "less than the Kalman filter, in all by" in found.notes[0]
    assert "LQG controller is left out: it was not asked for" in found.notes[1]
    assert not any(note.endswith(".") for note in found.notes)  # whoever prints one ends it


def test_a_method_that_a_possible_gain_makes_unstable_is_not_chosen(record, models):
    designs = {"kalman": worse, "hinf": lbt.kalman, "lqg": worse}
    found, _ = choose(record, models, designs, is_safe=lambda _: False)
    assert found.method == "kalman"
    assert [row.name for row in found.rows] == ["Kalman filter", "LQG controller"]
    assert any("H-infinity filter is left out: its loop is unstable" in n for n in found.notes)


def test_without_the_default_the_best_is_chosen(record, models):
    found, _ = choose(record, models, {"lqg": worse, "hinf": lbt.kalman})
    assert found.method == "hinf"
    assert "of the methods that are left" in found.notes[0]
    assert "Kalman filter is left out" in " ".join(found.notes)


def test_what_cannot_be_compared_leaves_the_default(record, models):
    found, _ = choose(record, models, {})
    assert (found.method, found.rows) == ("kalman", ())
    assert len(found.notes) == len(quick_methods())
    assert all("is left out: it was not asked for" in note for note in found.notes)


@pytest.mark.parametrize(
    ("differences", "error", "chosen"),
    [
        ((40.0, 40.0, 40.0), 4.0, "hinf"),
        ((400.0, 400.0, 10.0), 1.0, "kalman"),  # less than 2 % of the variance on one test
        ((400.0, 400.0, -20.0), 1.0, "kalman"),  # more on one
        ((25.0, 25.0, 25.0), 20.0, "kalman"),  # within two errors
        ((-20.0, -20.0, -20.0), 1.0, "kalman"),
    ],
)
def test_the_default_stays_unless_another_wins_every_test(
    record, models, monkeypatch, differences, error, chosen
):
    left = {"kalman": [], "hinf": []}
    for i, difference in enumerate(differences):
        common, own = np.random.default_rng(i).standard_normal((2, 6000))
        common *= np.sqrt(1000 / np.mean(common**2))
        own -= common * (common @ own) / (common @ common)
        # its product with the common part scatters
        size = 6000 * error**2 / 4000
        own *= np.sqrt(size / np.mean(own**2))
        series = {
            "kalman": common,
            "hinf": np.sqrt(1 - (difference + size) / 1000) * common + own,
        }
        for name, values in series.items():
            residual = estimate_residual(values[:, None], ((0, 6000),), *np.zeros((2, 1, 1)))
            left[name].append(residual)
        above, its_error = left["kalman"][i].above(left["hinf"][i])
        assert above == pytest.approx(difference)
        assert its_error == pytest.approx(error, rel=0.3) or difference >= 400
    ordered = dict(sorted(left.items(), key=lambda row: sum(x.total_nm2 for x in row[1])))
    monkeypatch.setattr(auto, "_replay_methods", lambda *_: (ordered, {}))
    assert choose(record, models, {"hinf": lbt.kalman})[0].method == chosen


def test_slow_methods_are_not_tried(monkeypatch):
    assert default_method() in quick_methods()
    assert not any(method_named(name).slow for name in quick_methods())
    usual = method_named(default_method())
    for slow in (False, True):
        newcomer = replace(usual, name="newcomer", slow=slow)
        monkeypatch.setitem(registry._methods_of_folder(), "newcomer", newcomer)
        assert ("newcomer" in quick_methods()) is not slow
