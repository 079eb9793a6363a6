"""One design for several nights: the mean of their plants, the choice, and what it says."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.recorded_loops import RATE, slow, spliced_record

import lbt_synth as lbt
from lbt_synth.errors import CertificateError, ProblemError
from lbt_synth.identification import LoopRecord
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.models.plant.tip_tilt import mean_plant
from lbt_synth.studies import design_from_nights, nights
from lbt_synth.studies.nights import ALL, NightsDesign

STILL = (58.0, 0.01, 25.0)  # a line that does not move: frequency [Hz], damping ratio, rms [nm]
MOVING = (0.004, 60.0)  # damping ratio and rms [nm] of one that does
NIGHTS = {"a": (28.5, 0.7, 6.0), "b": (31.0, 0.6, 7.0), "c": (34.0, 0.65, 8.0)}
HELD_OUT = ((29.0, 0.62, 7.0), (30.0, 0.7, 6.0), (32.5, 0.66, 8.0), (33.2, 0.6, 6.5))


def night(seed: int, hz: float, gain: float, noise: float, frames: int = 16_000) -> LoopRecord:
    """Return the record of a night, whose sensor gain is stated."""
    made = spliced_record(
        (seed,), lines=((hz, *MOVING), STILL), sensor_gain=gain, noise=noise, frames=frames
    )
    return replace(made, stated_gain=(gain,))


def true_plant(hz: float, gain: float = 1.0, noise: float = 7.0) -> TipTiltPlant:
    """Return the plant that is the truth of a night."""
    lines = [
        Vibration(frequency_hz=f, damping=z, rms_nm=rms, direction=(1.0,))
        for f, z, rms in ((hz, *MOVING), STILL)
    ]
    air = {"frame_rate_hz": RATE, "turbulence": slow(), "modes": 1}
    return lbt.tip_tilt_plant(**air, vibrations=lines, noise_nm=noise, sensor_gain=gain)


def left_nm2(design: lbt.Design, plant: TipTiltPlant) -> float:
    """Return the variance that a design leaves of a plant [nm^2]."""
    return lbt.residual_budget(design.close(plant.hardware), plant).rms_nm ** 2


@cache
def three_nights() -> NightsDesign:
    """Return the design for three nights, between which a line moves by a fifth."""
    seeds = enumerate(NIGHTS.items())
    return design_from_nights({name: night(seed, *facts) for seed, (name, facts) in seeds})


def test_a_loop_leaves_of_the_mean_plant_the_mean_of_what_it_leaves_of_the_nights() -> None:
    plants, weights = [true_plant(hz, noise=n) for hz, n in ((30, 5), (35, 8))], [1.0, 3.0]
    mean = mean_plant(plants, weights)
    filters = [lbt.kalman(plant) for plant in (mean, *plants)]
    means = []
    for design in filters:
        shares = np.average([left_nm2(design, plant) for plant in plants], weights=weights)
        assert left_nm2(design, mean) == pytest.approx(shares, rel=1e-9)
        means.append(shares)
    assert means[0] < 0.8 * min(means[1:])  # the least mean


def test_nights_that_are_equal_have_the_plant_of_one() -> None:
    plant = true_plant(31.0, gain=0.7)
    mean = mean_plant([plant] * 3, [1.0, 2.0, 5.0])
    for name in "ABCDL":
        np.testing.assert_allclose(getattr(mean, name), getattr(plant, name), rtol=1e-9, atol=1e-9)
    # the noise of a night counts in the phase
    halved = true_plant(31.0, gain=0.35, noise=3.5)
    both = mean_plant([plant, halved], [1.0, 1.0])
    gain = both.hardware.sensor[0, 0]
    assert gain == pytest.approx(0.7 / np.sqrt(2))
    assert both.R[0, 0] == pytest.approx((7.0 / 0.7 * gain) ** 2)


def test_lines_that_overlap_become_one_of_their_power() -> None:
    mean = mean_plant([true_plant(31.0), true_plant(31.06), true_plant(33.0)], [1.0, 1.0, 2.0])
    lines = {round(line.frequency_hz, 2): line.rms_nm for line in mean.vibrations}
    assert lines == pytest.approx({31.03: 60 / np.sqrt(2), 33.0: 60 / np.sqrt(2), 58.0: 25.0})


def test_a_drift_and_a_line_at_its_frequency_stay_apart() -> None:
    plant = true_plant(31.0)
    for damping in (300.0, 0.3):
        wide = Vibration(frequency_hz=31.01, damping=damping, rms_nm=90.0, direction=(1.0,))
        drifting = lbt.models.plant.tip_tilt.with_vibrations(plant, [wide, *plant.vibrations])
        mean = mean_plant([drifting, drifting, plant], [1.0, 1.0, 2.0])
        lines = [(line.damping, line.rms_nm) for line in mean.vibrations]
        assert np.array(lines) == pytest.approx(
            np.array([MOVING, (damping, 90 / np.sqrt(2)), STILL[1:]])
        )


def test_the_design_for_all_nights_holds_on_nights_that_it_has_not_seen() -> None:
    """Of true nights of other lines, beside the filter for the truth of each."""
    made = three_nights()
    assert made.name == ALL
    worst = {}
    for name, design in made.designs.items():
        truths = [true_plant(*facts) for facts in HELD_OUT]
        worst[name] = max(left_nm2(design, p) / left_nm2(lbt.kalman(p), p) for p in truths)
    assert worst[ALL] < 0.85 * min(worst[name] for name in NIGHTS)
    assert worst == pytest.approx({"a": 5.16, "b": 1.73, "c": 4.47, ALL: 1.39}, rel=0.05)
    assert made.design.certificate.passed


def test_a_design_for_the_worst_place_of_each_line_leaves_more_on_the_nights_themselves() -> None:
    """And less between them: its bands hold every place that the nights span."""
    made = three_nights()
    plant, bands = made.design.plant, ((28.5, 34.0, *MOVING[::-1]), (57.5, 58.5, 25.0, 0.01))
    robust = lbt.robust(
        plant,
        bands=[
            lbt.design.shaping.VibrationBand(low_hz=low, high_hz=high, rms_nm=rms, damping=damping)
            for low, high, rms, damping in bands
        ],
        states=None,
    )
    for name, least_nm in made.residual_nm[ALL].items():
        assert left_nm2(robust, made.nights[name].model.plant()) > 1.03 * least_nm**2
    between = true_plant(*HELD_OUT[2])
    assert left_nm2(robust, between) < left_nm2(made.design, between)


def test_the_table_has_what_each_design_leaves_of_the_truth_of_each_night() -> None:
    made = three_nights()
    for name, row in made.residual_nm.items():
        expected = [np.sqrt(left_nm2(made.designs[name], true_plant(*NIGHTS[n]))) for n in row]
        assert list(row.values()) == pytest.approx(expected, rel=0.15)
    assert made.worst("a") == pytest.approx(
        ((made.residual_nm["a"]["c"] / made.residual_nm["c"]["c"]) ** 2, "c")
    )


def test_the_verdict_says_what_one_night_costs_and_what_all_do() -> None:
    made = three_nights()
    first, second = made.verdict
    ratios = {name: made.worst(name)[0] for name in NIGHTS}
    worst, best = max(ratios, key=ratios.get), min(ratios, key=ratios.get)
    assert first.startswith(
        f"The design of one night alone, on its worst night: that of {worst} leaves "
        f"{ratios[worst]:.2f} times the variance of the night's own design on "
    )
    assert f"; that of {best} leaves {ratios[best]:.2f} times" in first
    ratio, where = made.worst(ALL)
    assert second.startswith(f"The design for all nights leaves {ratio:.2f} times the variance")
    assert f"on {where} (" in second
    assert second.endswith(" rms) at worst, and is written.")


@pytest.mark.parametrize(
    ("of_all", "words"),
    [
        ((30.0, 50.0), "at worst: worse on every night than that of b alone, which is written."),
        ((10.5, 50.0), "at worst: worse than that of b alone, which is written."),
        ((30.0, np.nan), "The design for all nights is unstable on b at worst: worse on every"),
        (None, "None holds for all nights; that of b alone is written."),
    ],
)
def test_the_verdict_of_a_design_of_one_night(of_all, words) -> None:
    table = {"a": (10.0, np.nan), "b": (15.0, 20.0)} | ({ALL: of_all} if of_all else {})
    residual_nm = {name: dict(zip("ab", row, strict=True)) for name, row in table.items()}
    made = three_nights()
    designs = {name: made.designs[name] for name in residual_nm}
    pair = {name: made.nights[name] for name in "ab"}
    made = replace(made, nights=pair, designs=designs, residual_nm=residual_nm)
    assert made.name == "b"
    assert made.design.plant is made.nights["b"].design.plant
    first, second = made.verdict
    assert "that of a is unstable on b; that of b leaves 2.25 times" in first
    assert words in second


def test_a_design_for_all_that_is_worse_gives_way_to_that_of_a_night(monkeypatch) -> None:
    def deaf(plants: list[TipTiltPlant], weights: list[float]) -> TipTiltPlant:
        """Return a plant of much noise and no line."""
        quiet = replace(plants[0].parts(), vibrations=(), noise_factor=np.array([[300.0]]))
        return lbt.models.plant.tip_tilt.assemble(quiet)

    monkeypatch.setattr(nights, "mean_plant", deaf)
    records = {name: night(seed, *NIGHTS[name]) for seed, name in enumerate("ab")}
    made = design_from_nights(records)
    best = min("ab", key=made.worst)
    assert made.name == best
    assert made.design.plant is made.nights[best].design.plant
    assert "a night allows: 0.7 and 0.6; the loop" in made.design.assumptions[0]
    assert f"worse on every night than that of {best} alone, which is written." in made.verdict[1]


def test_a_design_that_is_unstable_on_a_night_has_no_number() -> None:
    records = {"dim": night(0, 31.0, 0.2, 6.0), "bright": night(1, 31.0, 1.0, 6.0)}
    made = design_from_nights(records, command_scale_known=True)
    assert np.isnan(made.residual_nm["dim"]["bright"])
    assert made.worst("dim") == (np.inf, "bright")
    assert "that of dim is unstable on bright; that of bright leaves" in made.verdict[0]


def test_nights_of_which_no_design_holds_all_are_refused(monkeypatch) -> None:
    def away(design: lbt.Design, gains: np.ndarray) -> np.ndarray | None:
        """Return a gain that is another one than that of the design."""
        return None if np.allclose(gains, design.hardware.sensor) else gains[:, 0]

    monkeypatch.setattr(nights, "unstable_gains", away)
    records = {name: night(seed, *NIGHTS[name], frames=5000) for seed, name in enumerate("ab")}
    with pytest.raises(CertificateError, match="no design is stable on all nights. The") as caught:
        design_from_nights(records)
    assert "that of b is unstable on a; that of a is unstable on b. Leave a" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"frame_rate_hz": 500.0},
            "b has frame_rate_hz=500.0, and a frame_rate_hz=1000.0: one design",
        ),
        ({"delay_frames": 3.0}, "b has delay_frames=3.0, and a delay_frames=2"),
        ({"diameter_m": 8.0}, "b has diameter_m=8.0, and a diameter_m=None"),
    ],
)
def test_nights_of_different_loops_are_refused(changes, words) -> None:
    one = night(0, *NIGHTS["a"], frames=5000)
    with pytest.raises(ProblemError, match=words):
        design_from_nights({"a": one, "b": replace(one, **changes)})


def test_bad_nights_are_refused_by_name() -> None:
    one = night(0, *NIGHTS["a"], frames=5000)
    with pytest.raises(ProblemError, match="nights must be at least two; got 1"):
        design_from_nights({"a": one})
    with pytest.raises(ProblemError, match="method must be one of hinf, kalman, lqg, mixed"):
        design_from_nights({"a": one, "b": one}, method="predictor")
    two = lbt.identification.loop_record(
        np.hstack([one.measurements] * 2), frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    with pytest.raises(ProblemError, match="b has axes=2, and a axes=1"):
        design_from_nights({"a": one, "b": two})
    short = night(0, *NIGHTS["a"], frames=2000)
    with pytest.raises(ProblemError, match="^short: the record needs 4000 usable frames"):
        design_from_nights({"short": short, "b": one})
