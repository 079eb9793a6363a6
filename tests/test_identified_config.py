"""Configurations of identified systems: written, read again, and run by every command."""

from __future__ import annotations

import json
from dataclasses import astuple, dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.config.schema import FileSection
from lbt_synth.config.write import config_text

RATE = 1000.0


@dataclass(frozen=True, kw_only=True)
class Line:
    frequency_hz: float
    damping: float
    rms_nm: float
    frequency_error_hz: float = 0.01
    damping_error: float = 0.0004
    rms_error_nm: float = 1.5
    kind: str = "line"


@dataclass(frozen=True, kw_only=True)
class Axis:
    turbulence: lbt.models.ARModel
    parts: tuple = ()
    noise_nm: float = 15.5
    noise_error_nm: float = 0.12
    sensor_gain: float = 1.0
    sensor_gain_error: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Model:
    axes: tuple
    frame_rate_hz: float = RATE
    delay_frames: float = 2.0
    mirror: lbt.models.PositionLoop | None = None


def ar(*coefficients, driving):
    return lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=RATE)


TIP = Axis(
    turbulence=ar(1.9960123456789, -0.99602, driving=0.123456789012345),
    parts=(
        Line(frequency_hz=20.123456789, damping=0.0051, rms_nm=300.0),
        Line(frequency_hz=47.0, damping=0.01, rms_nm=40.0),
    ),
    sensor_gain=0.83,
    sensor_gain_error=0.011,
)
TILT = Axis(
    turbulence=ar(0.9899, driving=31.0),
    parts=(Line(frequency_hz=13.7, damping=0.02, rms_nm=120.0),),
    noise_nm=9.25,
    sensor_gain=0.71,
    sensor_gain_error=float("nan"),
)
TWO = Model(axes=(TIP, TILT))
ONE_AXIS = Model(axes=(replace(TIP, sensor_gain=1.0),))
SHELL = lbt.models.PositionLoop.of_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=500)


def saved(tmp_path, model, name="model.yaml", **options):
    settings, comments = lbt.config.identified_config(model, **options)
    return lbt.config.save_config(tmp_path / name, settings, comments=comments)


@pytest.mark.parametrize(
    "model", [TWO, ONE_AXIS, replace(TWO, mirror=SHELL), replace(TWO, delay_frames=2.4)]
)
def test_what_was_identified_is_what_is_read(tmp_path, model):
    config = lbt.load_config(saved(tmp_path, model))
    plant = config.plant
    assert config.atmosphere is None
    assert config.imaging.diameter_m is None
    assert plant.hardware.modes == len(model.axes)
    assert plant.hardware.delay_frames == model.delay_frames
    if model.mirror is None:
        assert plant.hardware.mirror is None
    else:
        assert astuple(plant.hardware.mirror) == astuple(model.mirror)
    gains = [axis.sensor_gain for axis in model.axes]
    np.testing.assert_array_equal(plant.hardware.sensor, np.diag(gains))
    for own, axis in zip(plant.turbulence, model.axes, strict=True):
        np.testing.assert_array_equal(own.coefficients, axis.turbulence.coefficients)  # all digits
        assert own.driving_rms_nm == axis.turbulence.driving_rms_nm
    noise = [axis.noise_nm for axis in model.axes]
    np.testing.assert_allclose(np.sqrt(np.diag(plant.R)), noise, rtol=1e-14)
    lines = [(i, line) for i, axis in enumerate(model.axes) for line in axis.parts]
    assert len(plant.vibrations) == len(lines)
    for made, (i, line) in zip(plant.vibrations, lines, strict=True):
        assert made.direction == tuple(np.eye(len(model.axes))[i])
        assert (made.frequency_hz, made.damping, made.rms_nm) == (
            line.frequency_hz,
            line.damping,
            line.rms_nm,
        )
    truth = config.truth
    assert truth.turbulence_of(len(model.axes)) == plant.turbulence
    assert truth.vibrations == plant.vibrations
    assert truth.noise_of(len(noise)).tolist() == noise
    assert truth.sensor_gain == 1.0


def test_the_residual_of_the_kalman_filter_is_the_estimation_error(tmp_path):
    """The truth is the model: an exact check of the whole chain."""
    config = lbt.load_config(saved(tmp_path, TWO))
    design = lbt.kalman(config.plant)
    loop = lbt.close_loop(config.hardware, design.controller)
    assert lbt.residual_budget(loop, config.truth).rms_nm == pytest.approx(design.rms, rel=1e-8)
    assert lbt.loop.least_residual(config.hardware, config.truth).rms_nm == pytest.approx(
        design.rms, rel=1e-6
    )


def test_standard_errors_stand_beside_their_numbers(tmp_path):
    text = saved(tmp_path, TWO, title="Night of tests.\nSecond line.").read_text()
    assert text.startswith("# Night of tests.\n# Second line.\nversion: 1\n")
    rows = {
        row.split(":")[0].strip(): row for row in text.splitlines() if "#" in row and ":" in row
    }
    assert "[15.5, 9.25]" in rows["noise_nm"]
    assert rows["noise_nm"].endswith("# standard error 0.12, 0.12 nm")
    assert rows["sensor_gain"].endswith("# standard error 0.011, not known")
    assert "20.123456789 " in text
    assert "# standard error 0.01 Hz" in text
    assert "# standard error 0.0004" in text
    assert "# standard error 1.5 nm" in text
    assert "# tip, rms" in text
    # a gain of 1 that was not estimated is not worth a key
    assert "sensor_gain" not in saved(tmp_path, ONE_AXIS).read_text()


def test_a_telescope_is_written_where_it_is_known(tmp_path):
    camera = {"diameter_m": 8.22, "obstruction": 0.11, "wavelength_um": 1.65}
    config = lbt.load_config(saved(tmp_path, TWO, **camera, other_modes_strehl=0.8))
    for name, value in camera.items():
        assert getattr(config.imaging, name) == value
    assert config.imaging.other_modes == 0.8


def test_quiet_axes_have_no_vibrations(tmp_path):
    calm = Model(axes=(replace(TIP, parts=()), replace(TILT, parts=())))
    config = lbt.load_config(saved(tmp_path, calm))
    assert config.plant.vibrations == ()
    assert config.truth.vibrations == ()


@pytest.mark.parametrize(
    ("model", "options", "text"),
    [
        (Model(axes=()), {}, "one or two axes; got a model of 0"),
        (Model(axes=(TIP, TILT, TIP)), {}, "one or two axes; got a model of 3"),
        (TWO, {"obstruction": 0.1}, "diameter_m, which is missing"),
        (TWO, {"diameter_m": -1.0}, "telescope.diameter_m"),
        (TWO, {"wavelength_um": float("nan")}, "imaging.wavelength_um"),
        (replace(TWO, delay_frames=float("nan")), {}, "delay_frames"),
        (replace(TWO, delay_frames=None), {}, "delay_frames"),
        (Model(axes=(replace(TIP, noise_nm=0.0),)), {}, "sensor.noise_nm"),
        (Model(axes=(replace(TIP, sensor_gain=-1.0),)), {}, "model.sensor_gain"),
        (
            Model(axes=(replace(TIP, parts=(Line(frequency_hz=3, damping=1.0, rms_nm=1),)),)),
            {},
            r"model.vibrations\[0\].damping",
        ),
    ],
)
def test_models_that_no_configuration_can_hold(model, options, text):
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.config.identified_config(model, **options)


def test_the_smallest_file_of_the_documentation(tmp_path):
    page = (ROOT / "docs" / "configuration.md").read_text()
    path = tmp_path / "page.yaml"
    path.write_text(page.split("```yaml\n")[1].split("```")[0])
    config = lbt.load_config(path)
    design = lbt.kalman(config.plant)
    loop = lbt.close_loop(config.hardware, design.controller)
    assert lbt.residual_budget(loop, config.truth).rms_nm == pytest.approx(design.rms, rel=1e-8)


# --- the writer


@pytest.mark.parametrize("name", ["lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"])
def test_the_examples_are_written_as_they_are(tmp_path, name):
    before = lbt.load_config(ROOT / "examples" / name)
    after = lbt.load_config(lbt.config.save_config(tmp_path / name, before.settings))
    assert after.settings == before.settings
    assert after.settings.model_fields_set == before.settings.model_fields_set
    np.testing.assert_array_equal(after.plant.A, before.plant.A)
    assert after.truth.vibrations == before.truth.vibrations


positive = st.floats(1e-300, 1e300)
finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    noise=positive | st.lists(positive, min_size=1, max_size=3),
    a=st.lists(finite, min_size=1, max_size=5),
    angle=finite,
    frequency=positive,
    frames=st.integers(2, 10**12),
    scale=st.none() | positive,
    many=st.booleans(),
)
def test_whatever_is_set_is_read_again(noise, a, angle, frequency, frames, scale, many):
    ar_section = {"kind": "ar", "coefficients": a, "driving_rms_nm": frequency}
    settings = FileSection.model_validate(
        {
            "version": 1,
            "atmosphere": {
                "seeing_arcsec": frequency,
                "outer_scale_m": scale,
                "wind_speed_m_s": frequency,
            },
            "sensor": {"noise_nm": noise, "matrix": [a, a]},
            "loop": {"frame_rate_hz": frequency},
            "model": {
                "turbulence": [ar_section, {"kind": "ar1"}] if many else ar_section,
                "vibrations": [
                    {
                        "direction_deg": angle,
                        "frequency_hz": frequency,
                        "damping": 0.1,
                        "rms_nm": frequency,
                    },
                ],
            },
            "truth": {"vibrations": "model"} if many else {"vibrations": []},
            "simulation": {"frames": frames},
        }
    )
    text = config_text(settings, {"loop.frame_rate_hz": "a # comment: [odd] ' \" é"})
    assert "odd" in text  # config_text reads it again, and refuses what has changed


@pytest.mark.parametrize(
    ("comments", "text"),
    [
        ({"loop.frame_rate_khz": "?"}, "one on loop.frame_rate_khz"),
        ({"loop.delay_frames": "a\nb"}, "must be one line"),
        ({"loop.frame_rate_hz": "\x00"}, "cannot be written so that it is read again"),
    ],
)
def test_comments_that_have_no_place(tmp_path, comments, text):
    settings, _ = lbt.config.identified_config(ONE_AXIS)
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.config.save_config(tmp_path / "a.yaml", settings, comments=comments)
    assert not list(tmp_path.iterdir())


def test_only_configurations_are_written(tmp_path):
    with pytest.raises(lbt.errors.ProblemError, match="FileSection"):
        lbt.config.save_config(tmp_path / "a.yaml", {"version": 1})
    settings, _ = lbt.config.identified_config(ONE_AXIS)
    with pytest.raises(lbt.errors.OutputError, match="cannot write"):
        lbt.config.save_config(tmp_path / "none" / "a.yaml", settings)


# --- every command on such a configuration


def run(capsys, *arguments, expect=0):
    status = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert status == expect, err
    assert "Traceback" not in out + err
    return out if expect == 0 else err


def answer(capsys, *arguments):
    return json.loads(run(capsys, *arguments, "--json"))


@pytest.mark.parametrize("model", [TWO, ONE_AXIS], ids=["two axes", "one axis"])
def test_every_command_runs(tmp_path, capsys, model):
    config = saved(tmp_path, model)
    config.write_text(config.read_text() + "\nrobustness:\n  errors_hz: [-1, 0, 1]\n")
    gain, integrator = tmp_path / "k.fits", tmp_path / "i.fits"
    made = answer(capsys, "design", config, "--method", "kalman", "-o", gain)
    assert made["above_limit_percent"] == pytest.approx(0, abs=1e-5)
    answer(capsys, "design", config, "--method", "integrator", "-o", integrator)
    hinf = answer(
        capsys,
        "design",
        config,
        "--method",
        "hinf",
        "--route",
        "riccati",
        "-o",
        tmp_path / "h.fits",
    )
    assert hinf["gamma"] < made["gamma"]
    lqg = answer(capsys, "design", config, "--method", "lqg", "-o", tmp_path / "l.fits")
    assert lqg["rms"] == pytest.approx(made["rms"], rel=1e-6)

    shown = run(capsys, "show", gain)
    assert "nm" in shown
    assert "nan" not in shown
    sigma = answer(capsys, "sigma", gain, integrator, "-o", tmp_path / "s.png")
    assert all(design["stable"] for design in sigma["designs"].values())
    simulated = answer(
        capsys,
        "simulate",
        config,
        gain,
        "--frames",
        "4000",
        "--cases",
        "2",
        "--telemetry",
        tmp_path / "t.fits",
        "-o",
        tmp_path / "sim.png",
    )
    assert simulated["residual_exact_nm"] == pytest.approx(made["rms"], rel=1e-6)
    assert np.sqrt(np.mean(np.square(simulated["residual_nm"]))) == pytest.approx(
        made["rms"], rel=0.1
    )
    assert simulated["sensor_gain"] == pytest.approx(np.mean([a.sensor_gain for a in model.axes]))
    seen = lbt.files.load_telemetry(tmp_path / "t.fits")
    assert seen.diameter_m is None
    assert 0 < seen.strehl < 1
    assert "telescope" not in run(capsys, "telemetry", tmp_path / "t.fits")

    limits = answer(capsys, "limits", config, integrator, "-o", tmp_path / "l.png")
    assert limits["limit_nm"] == pytest.approx(made["rms"], rel=1e-6)
    anew = answer(capsys, "robustness", config, "-o", tmp_path / "r.csv")
    best = {row["method"]: row for row in anew["rows"] if row["error_hz"] == 0}
    assert best["kalman"]["residual_nm"] == pytest.approx(made["rms"], rel=1e-6)
    mapped = answer(
        capsys,
        "robustness",
        config,
        gain,
        "--errors-hz",
        "-1",
        "1",
        "3",
        "--sensor-gains",
        "0.7",
        "0.9",
        "3",
        "-o",
        tmp_path / "m.png",
    )
    assert np.array(mapped["maps"]["k"]["strehl"]).shape == (1, 3, 3)
    front = answer(
        capsys, "tradeoff", config, "--points", "2", "--taps", "2", "-o", tmp_path / "f.png"
    )
    assert front["points"]
    run(capsys, "verify", gain)
    for form in ("c", "mat", "iir"):
        exported = tmp_path / f"x.{ {'c': 'c', 'mat': 'mat', 'iir': 'fits'}[form] }"
        run(capsys, "export", gain, "-o", exported, "--format", form)
        assert exported.exists()


def test_commands_that_need_more_say_so(tmp_path, capsys):
    config = saved(tmp_path, TWO)
    error = run(capsys, "modal", config, "--modes", "20", "-o", tmp_path / "m.png", expect=2)
    assert "the key atmosphere is missing" in error
    uneven = lbt.load_config(ROOT / "examples" / "lbt.yaml").settings.model_dump(exclude_unset=True)
    uneven["sensor"] = {"noise_nm": [15.5, 9.0]}
    lbt.config.save_config(tmp_path / "u.yaml", FileSection.model_validate(uneven))
    error = run(capsys, "modal", tmp_path / "u.yaml", "-o", tmp_path / "m.png", expect=2)
    assert "sensor.noise_nm must be one number for hundreds of modes" in error
    error = run(capsys, "mirror", config, "-o", tmp_path / "m.png", expect=2)
    assert "mirror.local_loop is missing" in error
    error = run(capsys, "design", config, "--method", "robust", "-o", tmp_path / "m.fits", expect=2)
    assert "design.robust is missing" in error
    with pytest.raises(
        lbt.errors.ConfigError, match="the key telescope is missing: an end-to-end"
    ) as caught:
        _ = lbt.load_config(config).end_to_end
    assert caught.value.path == "telescope"
