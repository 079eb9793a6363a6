"""A design from a record: the method that it asks for, the gains that it allows, and notes."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from support.night import GAIN, night_record
from support.recorded_loops import LINE, RATE, drifting_record, resonant_record, spliced_record
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import CertificateError, ProblemError
from lbt_synth.identification import IdentifiedModel, LoopRecord, auto, loop_record
from lbt_synth.identification.prediction.regression import noisier
from lbt_synth.identification.prediction.residual import estimate_residual
from lbt_synth.methods import registry
from lbt_synth.methods.registry import default_method, method_named

LOOP = {"frame_rate_hz": RATE, "delay_frames": 2, "unit": "nm"}
SERIES = ("measurements", "commands")
USUAL, OTHER = (method_named(name).title for name in ("kalman", "hinf"))


@cache
def strong_loop(line=LINE) -> tuple[LoopRecord, IdentifiedModel]:
    """Return the record of a loop of sensor gain 0.9, and its model."""
    made = spliced_record((0,), lines=line, frames=20_000, sensor_gain=0.9)
    return made, lbt.identify(made)


def test_a_design_is_doubted_where_the_gains_disagree() -> None:
    other = spliced_record((1,), lines=LINE, frames=12_000, sensor_gain=0.4)
    pairs = ((getattr(strong_loop()[0], name)[:12_000], getattr(other, name)) for name in SERIES)
    made = lbt.design_from_record(loop_record(*map(np.vstack, pairs), **LOOP), method="hinf")
    assert made.name == "H-infinity filter"
    assert any("sensor gain" in note for note in made.notes)


def test_a_design_needs_a_delay_and_data():
    noise = np.random.default_rng(0).standard_normal((9000, 1))
    short, late = loop_record(noise[:900], **LOOP), loop_record(noise, noise, **LOOP)
    rows = [
        (replace(late, delay_frames=None), {}, "delay .*; give delay_frames"),
        (noise, {}, "LoopRecord"),
        (short, {}, r"needs 4000 usable frames \(4 s at 1000 Hz\).*got 900 \(0.9"),
        (short, {"method": "magic"}, "method"),
    ]
    require_refusals(
        (partial(lbt.design_from_record, record, **options), ProblemError, words)
        for record, options, words in rows
    )


def test_what_a_filter_leaves_of_a_drift_is_noted():
    rate = 500.0
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=rate)
    plant = lbt.tip_tilt_plant(frame_rate_hz=rate, turbulence=air, noise_nm=5.0, sensor_gain=0.5)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    residual = abs(loop.sensitivity([1e-6])[0, 1, 1])
    assert 0.01 < residual < 0.5
    noise, commands = np.random.default_rng(0).standard_normal((5000, 2)), np.zeros((5000, 2))
    notes = []
    for offset_nm, speed_nm_s in ((10.0, 1.0), (3000.0, -200.0)):
        commands[:, 1] = offset_nm + speed_nm_s * (np.arange(5000) - 2500) / rate
        record = loop_record(noise, commands, **LOOP | {"frame_rate_hz": rate})
        notes.append([*auto.note_drift(record, plant, loop)])
    quiet, (note,) = notes
    assert quiet == []
    assert note.startswith("axis 1 of the record stands 3e+03 nm off zero and drifts by -200 nm/s.")
    said = float(note.split("leaves up to ")[1].split(" nm")[0])
    assert said == pytest.approx(residual * (3000 + 5 * 200), rel=0.05)


def residuals(differences, error):
    """Return residuals of two methods, the other's below 1000 by differences on three parts."""
    series = [], []
    for i, less in enumerate(differences):
        white = np.random.default_rng(i).standard_normal((6000, 2))
        common, own = np.sqrt(6000) * np.linalg.qr(white)[0].T
        scatter = 6000 * error**2 / 4000  # of its product with the common part
        series[0].append(np.sqrt(1000) * common)
        series[1].append(np.sqrt(1000 - less - scatter) * common + np.sqrt(scatter) * own)
    zero = np.zeros((1, 1))
    return [
        estimate_residual(np.concatenate(parts)[:, None], ((5, 18_005),), zero, zero)
        for parts in series
    ]


@pytest.mark.parametrize(
    ("differences", "error", "chosen"),
    [
        ((40.0, 40.0, 40.0), 4.0, OTHER),
        ((400.0, 400.0, 10.0), 1.0, USUAL),  # less than 2 % of the variance on one part
        ((400.0, 400.0, -20.0), 1.0, USUAL),  # more on one
        ((25.0, 25.0, 25.0), 20.0, USUAL),  # within two errors
        ((-20.0, -20.0, -20.0), 1.0, USUAL),
    ],
)
def test_the_default_stays_unless_another_wins_every_part(differences, error, chosen):
    usual, other = residuals(differences, error)
    for row in zip(usual.parts(3), other.parts(3), differences, strict=True):
        above, its_error = row[0].above(row[1])
        assert above == pytest.approx(row[2])
        assert its_error == pytest.approx(error, rel=0.3) or row[2] >= 400
    title, note = auto.choose_method({USUAL: usual, OTHER: other})
    assert title == chosen
    assert ("the Kalman filter stays" in note) == (chosen == USUAL)
    if chosen == OTHER:
        _, error = usual.above(other)
        assert "the H-infinity filter is chosen" in note
        assert note.endswith(f"less than the Kalman filter, in all by 40 +- {error:.2g} nm^2")
    # without the default the best is chosen
    assert auto.choose_method({OTHER: other})[0] == OTHER


def test_a_residual_that_the_noise_hides_wins_by_its_bound_only():
    """Of 300 and 0 nm^2, the second is chosen as long as it is surely below 300."""
    levels, less = residuals((300.0, 300.0, 300.0), 4.0), np.full((1, 1), 700.0)
    for error_nm2, chosen in ((100.0, OTHER), (200.0, USUAL)):
        usual, other = (
            replace(
                level,
                noise_nm2=less,
                covariance_nm2=level.covariance_nm2 - less,
                error_nm4=np.full((1, 1), error_nm2**2),
            )
            for level in levels
        )
        assert other.hidden
        title, note = auto.choose_method({USUAL: usual, OTHER: other})
        assert title == chosen
        assert ("as far as the noise shows" in note) == (chosen == USUAL)


def test_all_quick_methods_are_in_the_table_of_unseen_data(monkeypatch):
    made = lbt.design_from_record(night_record(), sensor_gain=GAIN, most_lines=1)
    names = [row.name for row in made.held_out.entries]
    assert {method_named(name).title for name in auto.quick_methods()} < set(names)
    assert (made.name, made.design.method) == ("Kalman filter", "kalman")
    (note,) = made.notes
    assert note.startswith("the Kalman filter stays")
    assert default_method() in auto.quick_methods()
    for slow in (False, True):
        newcomer = replace(method_named(default_method()), name="newcomer", slow=slow)
        monkeypatch.setitem(registry.METHODS, "newcomer", newcomer)
        assert ("newcomer" in auto.quick_methods()) is not slow


@pytest.mark.parametrize(
    ("make", "gain", "widest"),
    [
        (night_record, GAIN, 2),
        (resonant_record, 0.9, 1.6),
        # a drift over frozen flow: what the loop leaves is coloured noise over a line, at no gain
        (lambda: drifting_record(337), 0.5859, 4),
    ],
)
def test_the_true_gain_is_allowed(make, gain, widest) -> None:
    seen = make()
    known = LOOP | {"frame_rate_hz": seen.frame_rate_hz}
    made = loop_record(seen.measurements[:, 0], seen.commands[:, 0], **known)
    model = lbt.identify(made)
    low, high = auto.allowed_gains(made, model).T
    assert np.all((low < gain) & (gain < high) & (high < widest * low))
    assert model.sensor_gains[0] == pytest.approx(gain, abs=3 * model.axes[0].sensor_gain_error)


def test_the_interval_is_what_the_fit_the_sensor_and_the_law_allow() -> None:
    """The integrator of gain 0.4 was stable below a sensor gain of 2.5, and sensors have 0.2 to 1.25."""
    made, model = strong_loop()
    (axis,), spread = model.axes, np.exp(3 * 0.4 / 1.3)
    cases = [
        (replace(axis, sensor_gain=gain, sensor_gain_error=error), interval)
        for gain, error, interval in (
            (0.8, 0.08, (0.8 * np.exp(-0.3), 0.8 * np.exp(0.3))),
            (0.8, 0.4, (0.2, 1.25)),
            (1.3, 0.4, (1.3 / spread, 2.5)),
        )
    ]
    odd = replace(axis, whiteness=replace(axis.whiteness, p_value=1e-9))
    spread = 1.5 * np.exp(3 * odd.sensor_gain_error / odd.sensor_gain)
    for changed, interval in [*cases, (odd, (odd.sensor_gain / spread, 1.25))]:
        gains = auto.allowed_gains(made, replace(model, axes=(changed,)))
        assert gains[0].tolist() == pytest.approx(interval)


def test_gains_at_which_a_loop_is_unstable() -> None:
    """An integrator of gain g is stable below a sensor gain of 1 / g, and less where it is late."""
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    assert auto.unstable_gains(design, np.array([[0.1, 1.8], [0.2, 1.8]])) is None
    assert auto.unstable_gains(design, np.array([[0.1, 1.0], [0.2, 2.01]]))[1] == 2.01
    late = replace(design.hardware, delay_frames=2.1)
    _, high = lbt.loop.stable_sensor_gains(late, design.controller)
    assert 1.9 < high < 2
    for gain, stable in ((0.999 * high, True), (1.001 * high, False)):
        assert (auto.unstable_gains(design, np.array([[gain, gain]] * 2)) is None) is stable


def noisy(model: IdentifiedModel, synthesis=lbt.kalman, **options):
    """Return how a filter is designed for a model and more noise."""
    return lambda added_nm: synthesis(noisier(model, added_nm).plant(), **options)


# a filter whose controller alone is unstable
careless = partial(noisy, synthesis=lbt.hinf, gamma_ratio=1.02, route="riccati")


NARROW = ((60.0, 0.004, 100.0),)  # frequency [Hz], damping, rms [nm]


def design_for(model, allowed, *, known=True, make=noisy):
    """Return the design, the noise that it adds to each axis, and a note."""
    return auto.design_for_gains(model, make(model), allowed, command_scale_known=known)


def beyond_its_margin(model: IdentifiedModel, factor: float = 1.1) -> np.ndarray:
    """Return gains from the model's to a factor beyond the largest of its filter's stable loop."""
    (gain,) = model.sensor_gains
    _, high = lbt.loop.stable_sensor_gains(model.hardware, noisy(model)(0.0).controller)
    return np.array([[0.9 * gain, factor * high * gain]])


def test_gains_that_the_fit_shows_keep_the_design() -> None:
    model = strong_loop()[1]
    design, added_nm, note = design_for(model, np.array([[0.6, 1.2]]))
    assert design.method == "kalman"
    (text,) = design.assumptions
    assert "the loop is stable at all of these" in text
    assert "at the size that was applied, as was stated" in text
    assert (added_nm.tolist(), note) == ([0.0], "")
    free, *_ = design_for(model, None, known=False)
    assert free.assumptions == ()


def test_more_noise_is_assumed_where_the_fitted_design_is_unstable() -> None:
    """At the price that the note says: the least noise that is stable, to a tenth."""
    _, model = strong_loop(NARROW)
    allowed = beyond_its_margin(model)
    tried_nm = list[float]()

    def recorded(model: IdentifiedModel):
        return lambda nm: tried_nm.append(float(nm[0])) or noisy(model)(nm)

    safe, (added_nm,), note = design_for(model, allowed, make=recorded)
    assert auto.unstable_gains(safe, allowed) is None
    assert f"to be stable at sensor gains of {allowed[0, 0]:.3g} to" in note
    assert f"the design assumes {added_nm:.3g} nm more noise on each axis" in note
    loops = [lbt.close_loop(model.hardware, each.controller) for each in (noisy(model)(0.0), safe)]
    least, paid = (lbt.residual_budget(loop, model.truth()).rms_nm for loop in loops)
    assert least < paid < 1.1 * least
    stable = {nm for nm in tried_nm if auto.unstable_gains(noisy(model)(nm), allowed) is None}
    noise_nm = model.axes[0].noise_nm / model.axes[0].sensor_gain
    (reached, failed) = np.hypot(noise_nm, [min(stable), max(set(tried_nm) - stable)])
    assert added_nm == min(stable)
    assert reached < 1.15 * failed
    # an axis that is stable without stays as it is
    calm = replace(model.axes[0], noise_nm=8 * model.axes[0].noise_nm)
    both = replace(model, axes=(model.axes[0], calm))
    safe, pair_nm, note = design_for(both, np.repeat(allowed, 2, axis=0))
    assert auto.unstable_gains(safe, np.repeat(allowed, 2, axis=0)) is None
    assert pair_nm == pytest.approx([added_nm, 0.0])
    assert f"{added_nm:.3g} nm more noise on axis 0. Give" in note
    # a gain that the record leaves open is asked for
    wide = beyond_its_margin(model, 1.5) * [0.5, 1.0]
    *_, note = design_for(model, wide)
    assert note.startswith("warning: to be stable")
    assert "Give --sensor-gain, which the record leaves open" in note


def test_commands_of_unknown_scale_ask_for_stability_at_half_the_gain() -> None:
    (_, model), allowed = strong_loop(NARROW), np.array([[0.85, 0.95]])
    best, *_ = design_for(model, allowed, make=careless)
    safe, _, note = design_for(model, allowed, make=careless, known=False)
    assert auto.unstable_gains(best, allowed * [0.5, 1.0]) is not None
    assert auto.unstable_gains(safe, allowed * [0.5, 1.0]) is None
    assert "at half of them" in safe.assumptions[0]
    assert "--command-scale 1" in note


def test_axes_of_different_gains_may_have_those_of_both() -> None:
    """Commands of one axis at twice their size gave a design that was unstable in the loop."""
    night = night_record()
    made = replace(night, commands=night.commands * [1.0, 2.0])
    model = lbt.identify(made)
    assert model.sensor_gains == pytest.approx((0.7, 0.35), rel=0.15)
    assert any("recorded at another size" in note for note in model.notes)
    design, *_ = design_for(model, auto.allowed_gains(made, model), known=False)
    assert "each axis at those of both, because they differ" in design.assumptions[0]
    both = np.outer([1, 1], [min(model.sensor_gains), max(model.sensor_gains)])
    assert auto.unstable_gains(design, both) is None


def test_gains_at_which_nothing_is_stable_are_refused() -> None:
    model, wide = strong_loop()[1], np.array([[0.02, 0.9]])
    stubborn = careless(model)(0.0)
    for known in (True, False):
        call = partial(design_for, model, wide, known=known, make=lambda _: lambda _: stubborn)
        error = refused(call, CertificateError, r"the record allows 0.0\d to 0.9")
        assert ("Give --command-scale 1 if" in str(error)) is not known
