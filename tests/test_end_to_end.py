"""What of the end-to-end simulation needs no SPECULA: systems, cases, tables, figures of a run."""

import importlib.metadata
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.cli import end_to_end as end_to_end_commands
from lbt_synth.cli.main import main
from lbt_synth.errors import ConfigError, MissingExtraError, OutputError, ProblemError
from lbt_synth.interop.specula.json_cases import make_case
from lbt_synth.report.figures.end_to_end_table import end_to_end_table_figure
from lbt_synth.studies.paper.end_to_end import (
    all_cases,
    make_entries,
    plan_tables,
    rms_modal_difference,
)
from lbt_synth.studies.paper.published import TABLE_III

CONFIG = "examples/lbt.yaml"


@pytest.fixture(scope="module")
def setup():
    return lbt.load_config(CONFIG).end_to_end


def made_run(system, *, gain=0.5, noise_nm=10.0, frames=4000, seed=0):
    """A run whose measurements are a gain times the residual of the frame before, and noise."""
    rng = np.random.default_rng(seed)
    residual = 50 * rng.standard_normal((frames, system.modes))
    measured = np.zeros_like(residual)
    measured[1:] = gain * residual[:-1]
    measured += noise_nm * rng.standard_normal(measured.shape)
    return lbt.interop.EndToEndRun(
        system=system,
        strehl_series=0.8 + 0.01 * rng.standard_normal(frames),
        other_modes_series=np.full(frames, 0.85),
        measurements=measured,
        commands=np.zeros_like(residual),
        residual_nm=residual,
        psf=np.ones((4, 4)) / 16,
        psf_pixel_mas=20.0,
        seed=seed,
        settle_frames=200,
        seconds=1.0,
    )


def test_the_optical_gain_is_found_within_its_error(setup):
    system = replace(setup.system, modes=60)
    run = made_run(system)
    apart = (run.optical_gain - 0.5) / run.optical_gain_error
    assert 0.7 < np.std(apart) < 1.3
    assert abs(run.tip_tilt_gain - 0.5) < 4 * run.tip_tilt_gain_error
    assert run.tip_tilt_noise_nm == pytest.approx(10, rel=0.05)
    assert run.rms_nm == pytest.approx(np.full(60, 50), rel=0.05)


def test_the_strehl_ratio_and_its_error(setup):
    run = made_run(replace(setup.system, modes=3), frames=8000)
    assert run.strehl == pytest.approx(0.8, abs=1e-3)
    assert run.strehl_error == pytest.approx(0.01 / np.sqrt(8000), rel=0.6)
    assert run.other_modes_strehl == pytest.approx(0.85)
    short = made_run(replace(setup.system, modes=3), frames=10)
    assert np.isnan(short.strehl_error)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"diameter_m": 0}, "diameter_m"),
        ({"seeing_arcsec": float("nan")}, "seeing_arcsec"),
        ({"obstruction": 1.0}, "obstruction"),
        ({"read_noise_electrons": -1}, "read_noise_electrons"),
        ({"modes": 2}, "modes"),
        ({"pixels": 61}, "pixels must be even"),
        ({"pixels": 20}, "pixels must be even"),
        ({"pixels": 2000}, "pixels must be even"),
        ({"wind_direction_deg": float("inf")}, "wind_direction_deg"),
        ({"hardware": lbt.LoopHardware(frame_rate_hz=800, modes=3)}, "two modes"),
        (
            {"hardware": lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=2 * np.eye(2))},
            "sensor_matrix",
        ),
    ],
)
def test_systems_that_are_refused(setup, change, match):
    with pytest.raises(ProblemError, match=match):
        replace(setup.system, **change)


def test_a_phase_screen_is_longer_than_the_way_of_the_wind(setup):
    system = setup.system
    for frames in (10, 2000, 20000):
        length = system.screen_pixels(frames) * system.pixel_m
        assert length > frames / 800 * 20 + 2 * 8.22
        assert length > 6 * 22


def test_seeing_at_another_wavelength(setup):
    system = replace(setup.system, seeing_wavelength_um=2.2, seeing_arcsec=0.5)
    assert system.reference_seeing_arcsec == pytest.approx(0.5 * (2.2 / 0.5) ** 0.2)


def test_leaks_and_gains_of_the_mixed_controller(setup):
    control = setup.controller(None, tip_tilt_gain=0.7)
    first = control.step(np.ones(672))
    assert first[:2].tolist() == [0.7, 0.7]
    assert set(first[2:]) == {setup.gain}
    second = control.step(np.zeros(672))
    assert second[49] == setup.gain
    assert second[50] == pytest.approx(setup.leak * setup.gain)


def test_a_filter_of_another_loop_is_refused(setup):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    with pytest.raises(ProblemError, match=r"1000 Hz and 2 frames"):
        setup.controller(other)
    three = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=3), gain=0.5)
    with pytest.raises(ProblemError):
        setup.controller(three)


def test_a_filter_for_another_mirror_is_refused(setup):
    slow = lbt.load_config("examples/lbt_slow_mirror.yaml")
    with pytest.raises(ProblemError, match="another mirror"):
        setup.controller(lbt.lqg(slow.plant))
    with pytest.raises(ProblemError, match="another mirror"):
        slow.end_to_end.controller(lbt.kalman(lbt.load_config(CONFIG).plant))
    assert slow.end_to_end.controller(lbt.lqg(slow.plant)).n_modes == 672


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("outer_scale_m: 22.0", "outer_scale_m: null", "outer_scale_m must be a length"),
        ("turbulence: frozen_flow", "turbulence: none", "truth.turbulence must be frozen_flow"),
        ("mirror:\n  modes: 672 ", "mirror: {}\n# ", "mirror.modes is missing"),
        ("subapertures_across: 30", "subapertures_across: 80", "pixels must be even"),
        ("pixels: 60", "pixels: 61", "pixels must be even"),
    ],
)
def test_configurations_that_cannot_be_simulated(tmp_path, capsys, old, new, match):
    text = Path(CONFIG).read_text()
    assert old in text
    file = tmp_path / "c.yaml"
    file.write_text(text.replace(old, new, 1))
    config = lbt.load_config(file)
    with pytest.raises(ConfigError, match=match):
        _ = config.end_to_end
    assert main(["end-to-end", str(file), "x.fits", "-o", str(tmp_path / "run")]) == 2
    assert "lbt-synth: error:" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_sensor_matrix_cannot_be_simulated(tmp_path):
    text = Path(CONFIG).read_text().replace("sensor:\n", "sensor:\n  matrix: [[1, 0], [0, 2]]\n", 1)
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"sensor\.matrix must be left out"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end


def test_without_a_pyramid(tmp_path):
    text = Path(CONFIG).read_text()
    start, end = text.index("  pyramid:"), text.index("mirror:")
    (tmp_path / "c.yaml").write_text(text[:start] + "  noise_nm: 15.0\n\n" + text[end:])
    with pytest.raises(ConfigError, match=r"sensor\.pyramid is missing"):
        _ = lbt.load_config(tmp_path / "c.yaml").end_to_end


@pytest.mark.parametrize("found", [None, "1.0.3", "1.2.0"])
def test_without_the_extra_the_command_says_how_to_get_it(monkeypatch, tmp_path, capsys, found):
    def version(name):
        if name != "specula":
            return real(name)
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    real = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", version)
    gain = tmp_path / "i.fits"
    lbt.save_gain(gain, lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5))
    for arguments in (
        ["end-to-end", CONFIG, str(gain), "-o", str(tmp_path / "run")],
        ["end-to-end-table", CONFIG, "-o", str(tmp_path / "table"), "--tables", "II"],
    ):
        assert main(arguments) == 2
        assert 'pip install "lbt-synth[e2e]"' in capsys.readouterr().err
    with pytest.raises(MissingExtraError) as caught:
        lbt.interop.calibrate(lbt.load_config(CONFIG).end_to_end.system, cache=tmp_path)
    assert caught.value.extra == "e2e"


def test_the_telemetry_of_a_run_has_its_mirror(monkeypatch, tmp_path, setup):
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=150
    )
    slow = replace(setup.system.hardware, mirror=shell)
    run = made_run(replace(setup.system, modes=3, hardware=slow), frames=20)
    design = lbt.integrator(slow, gain=0.1)
    gain = lbt.save_gain(tmp_path / "i.fits", design)
    monkeypatch.setattr(end_to_end_commands, "specula_version", lambda: "1.1")
    seen = end_to_end_commands._telemetry(
        run, design, SimpleNamespace(key="k"), SimpleNamespace(gain=str(gain))
    )
    seen = lbt.files.load_telemetry(lbt.files.save_telemetry(tmp_path / "t.fits", seen))
    assert np.array_equal(seen.hardware.mirror_taps, slow.mirror_taps)
    assert "with the mirror taps c" in seen.convention


def test_a_case_holds_all_that_decides_and_fits_into_json(setup):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.3)
    shake = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100)
    case = make_case(setup, design.controller, vibrations=[shake], seed=3)
    assert json.loads(json.dumps(case)) is not None
    for other in (
        make_case(setup, None, vibrations=[shake], seed=3),
        make_case(setup, design.controller, seed=3),
        make_case(setup, design.controller, vibrations=[shake], seed=4),
        make_case(replace(setup, gain=0.4), design.controller, vibrations=[shake], seed=3),
        make_case(
            replace(setup, system=replace(setup.system, photons=51.0)),
            design.controller,
            vibrations=[shake],
            seed=3,
        ),
    ):
        assert json.dumps(other) != json.dumps(case)


@pytest.fixture(scope="module")
def rows(setup):
    fixed = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    return plan_tables(setup, {"slow": fixed}, seeds=(0, 1), row_seeds=(0,))


def test_the_tables_as_planned(rows):
    second = [row for row in rows if row.table == "II"]
    third = [row for row in rows if row.table == "III"]
    assert [(r.label, r.method, r.paper) for r in second[:3]] == [
        ("no vibration", "classical", 84.1),
        ("no vibration", "kalman", 80.7),
        ("no vibration", "hinf", 80.4),
    ]
    assert len(second) == 8
    assert len(third) == 3 * 15
    cases = all_cases(rows)
    # the 20 Hz row of Table III is the row with vibration of Table II
    assert len(cases) == 8 * 2 + 3 * 14
    moved = [
        c["vibrations"][0]["frequency_hz"]
        for n, c in cases.items()
        if n.startswith("slow-v") and "none" not in n
    ]
    assert sorted(set(moved)) == sorted(40 - row.model_hz for row in TABLE_III)
    still = {
        c["vibrations"][0]["frequency_hz"]
        for n, c in cases.items()
        if n.startswith("kal") and "none" not in n
    }
    assert still == {20.0}


def test_seeds_are_shared_by_the_controllers(rows):
    for row in rows:
        seeds = [case["setup"]["seed"] for case in row.cases.values()]
        expected = [0, 1] if row.table == "II" or row.error_hz == 0 else [0]
        assert seeds == expected


def fake_results(rows, gain=0.6, strehl=0.7):
    return {
        name: {
            "strehl": strehl + 0.01 * case["setup"]["seed"],
            "other_modes_strehl": 0.85,
            "tip_rms_nm": 30.0,
            "tilt_rms_nm": 40.0,
            "tip_tilt_gain": gain,
        }
        for name, case in all_cases(rows).items()
    }


@pytest.fixture(scope="module")
def table(setup, rows):
    some = [row for row in rows if row.error_hz in (None, -3.5, 0.0, 3.5)]
    return make_entries(some, fake_results(some), setup)


def test_entries_are_means_over_seeds_beside_the_modal_analysis(table):
    first = table[0]
    assert first.strehl == pytest.approx(70.5)
    assert first.scatter == pytest.approx(100 * 0.01 / np.sqrt(2))
    # the modal analysis by hand
    path = lbt.LoopHardware(frame_rate_hz=800)
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    truth = lbt.Truth(turbulence=air, noise_nm=15.5, sensor_gain=0.6)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller, sensor_gain=0.6)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11, wavelength_um=2.2, other_modes=0.85)
    expected = 100 * lbt.strehl(lbt.residual_budget(loop, truth), camera)
    assert first.modal == pytest.approx(expected, abs=1e-9)
    assert rms_modal_difference(table, "kalman") > 0
    # a filter for 20 Hz meets a line that moved: as bad as the model that moved
    slow = {e.error_hz: e.modal for e in table if e.method == "slow" and e.table == "III"}
    assert slow[-3.5] < slow[3.5]  # an integrator rejects 23.5 Hz less than 16.5 Hz


@pytest.mark.parametrize("gain", [-0.1, 0.0, 5.0])
def test_a_loop_that_is_unstable_at_the_measured_gain_predicts_nothing(setup, rows, gain):
    table = make_entries(rows, fake_results(rows, gain=gain), setup)
    assert {e.modal for e in table} == {0.0}


def test_the_figure_has_a_panel_a_controller(table):
    figure = end_to_end_table_figure(table)
    assert [axis.get_title() for axis in figure.axes] == ["Kalman", r"H$_\infty$", "slow"]
    assert figure.axes[0].lines[0].get_label() == "Agapito et al. 2008"


def test_tables_of_another_loop_are_refused(setup):
    hardware = lbt.LoopHardware(frame_rate_hz=1000)
    other = replace(setup, system=replace(setup.system, hardware=hardware))
    with pytest.raises(ProblemError, match="800 Hz with a delay of 2 frames"):
        plan_tables(other)


def test_a_design_cannot_take_the_name_of_the_papers(setup):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    with pytest.raises(ProblemError, match="the name kalman is taken"):
        plan_tables(setup, {"kalman": design})


@pytest.mark.parametrize(
    "arguments",
    [
        ["--seeds", "0"],
        ["--jobs", "0"],
        ["--frames", "1"],
        ["--settle-frames", "10"],
        ["--seed", "-1"],
        ["--seed", "5000000000"],
        ["--pixels", "7"],
        ["nowhere.fits"],
    ],
)
def test_bad_input_at_the_command_line(tmp_path, capsys, arguments):
    out = tmp_path / "table"
    assert main(["end-to-end-table", CONFIG, *arguments, "-o", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("lbt-synth: error:")
    assert captured.out == ""
    assert not out.exists()


def test_a_run_needs_a_controller_with_steps(setup):
    with pytest.raises(ProblemError, match="step"):
        lbt.interop.run_end_to_end(setup.system, object())


def test_the_cache_must_be_a_directory(tmp_path):
    from lbt_synth.interop.specula.calibration import cache_directory

    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cache directory"):
        cache_directory(tmp_path / "file" / "cache")


@settings(max_examples=25, deadline=None)
@given(gain=st.floats(0.1, 1.2), noise=st.floats(0.0, 60.0))
def test_the_gain_of_tip_and_tilt_lies_between_theirs(gain, noise):
    system = replace(lbt.load_config(CONFIG).end_to_end.system, modes=3)
    run = made_run(system, gain=gain, noise_nm=noise, frames=300)
    low, high = sorted(run.optical_gain[:2])
    assert low - 1e-12 <= run.tip_tilt_gain <= high + 1e-12
