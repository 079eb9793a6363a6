"""Records from telemetry: modes of slopes and commands, units, and what is refused."""

import numpy as np
import pytest
from support.records import SHELL

import lbt_synth as lbt

FAST = 1000.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=FAST)


def telemetry(frames=60, **changes):
    rng = np.random.default_rng(2)
    fields = {
        "frame_rate_hz": FAST,
        "delay_frames": 2.0,
        "commands": rng.standard_normal((frames, 2)),
        "measurements": rng.standard_normal((frames, 2)),
    }
    return lbt.files.Telemetry(**{**fields, **changes})


@pytest.mark.parametrize("axes", [1, 2])
def test_telemetry_of_a_simulation_with_matrices(axes):
    rng = np.random.default_rng(3)
    path = lbt.LoopHardware(
        frame_rate_hz=FAST,
        delay_frames=2.25,
        sensor_matrix=rng.standard_normal((3, axes)),
        influence_matrix=np.eye(axes) + 0.1 * rng.standard_normal((axes, axes)),
        mirror=SHELL,
    )
    truth = lbt.Truth(turbulence=SLOW, sensor_gain=0.7)
    design = lbt.integrator(path, gain=0.1)
    run = lbt.simulate(design.controller, truth, hardware=path, frames=400, seed=5)
    seen = lbt.load_record(lbt.files.telemetry_from_simulation(run, path))
    assert seen.axes == axes
    first = len(path.mirror_taps)
    z = seen.pseudo_open_loop(0.7)[first:]
    assert np.allclose(z, run.total_nm[0, first - 1 : -1], rtol=1e-9, atol=1e-8)
    assert "measurements: the inverse of the interaction matrix times what was recorded" in (
        seen.health.notes
    )


def test_modes_of_many():
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((2, 60, 5))
    many = telemetry(measurements=y, commands=u, diameter_m=8.0, name="night")
    with pytest.raises(
        lbt.errors.ProblemError, match=r"there are 5 modes; say which are tip and tilt: axes="
    ):
        lbt.load_record(many)
    seen = lbt.load_record(many, axes=(1, 0))
    assert np.array_equal(seen.measurements, y[:, [1, 0]])
    assert np.array_equal(seen.commands, u[:, [1, 0]])
    assert "axes are modes 1, 0 of 5" in seen.health.notes
    assert (seen.diameter_m, seen.source) == (8.0, "night")
    assert lbt.load_record(many, axes=[3]).axes == 1
    for bad in ((0, 0), (5,), (0, 1, 2), ()):
        with pytest.raises(
            lbt.errors.ProblemError, match="axes must be one or two different numbers below 5"
        ):
            lbt.load_record(many, axes=bad)


def test_slopes_with_their_modes_and_without():
    rng = np.random.default_rng(0)
    S = rng.standard_normal((8, 3))
    phase = rng.standard_normal((60, 3))
    slopes = phase @ S.T
    R = np.linalg.pinv(S)
    seen = lbt.load_record(
        telemetry(
            measurements=slopes @ R.T,
            slopes=slopes,
            interaction_matrix=S,
            reconstructor=R,
            commands=phase,
        ),
        axes=(0, 1),
    )
    assert np.allclose(seen.measurements, phase[:, :2])
    # a reconstructor of another gain is taken out
    half = lbt.load_record(
        telemetry(
            measurements=slopes @ R.T / 2,
            slopes=slopes,
            interaction_matrix=S,
            reconstructor=R / 2,
            commands=phase,
        ),
        axes=(0, 1),
    )
    assert np.allclose(half.measurements, phase[:, :2])
    with pytest.raises(
        lbt.errors.ProblemError,
        match=r"has 8 measurements and 3 modes: slopes without modal .*slopes @ R.T",
    ):
        lbt.load_record(
            telemetry(measurements=slopes, interaction_matrix=S, commands=phase), axes=(0, 1)
        )
    with pytest.raises(lbt.errors.ProblemError, match="slopes without modal coefficients"):
        lbt.load_record(telemetry(measurements=slopes, influence_matrix=np.eye(2)))


def test_the_timing_of_another_program_is_noted():
    for metadata, noted in (({}, False), ({"timing": "frames of the program"}, True)):
        seen = lbt.load_record(telemetry(metadata=metadata), axes=(0, 1))
        assert any("taken for granted" in note for note in seen.health.notes) is noted


@pytest.mark.parametrize(
    ("telemetry_changes", "options", "words"),
    [
        ({}, {"frame_rate_hz": 999}, "frame_rate_hz must be that of the telemetry, 1000; got 999"),
        ({}, {"unit": "mas"}, "unit must be that of the data, 'nm'; got 'mas'"),
        (
            {"measurement_unit": "pixel"},
            {},
            "the unit of mode 0 in 'pixel', mode 1 in 'pixel': give unit",
        ),
        ({"command_unit": "V"}, {}, "the unit of mode 0 in 'V', mode 1 in 'V': give command_unit"),
        (
            {"commands": np.ones((60, 3)), "interaction_matrix": np.eye(2)},
            {},
            "3 commands of 2 modes, and no influence matrix",
        ),
        ({"interaction_matrix": [[1.0, 1.0], [1.0, 1.0]]}, {}, "has no inverse"),
        ({"delay_frames": 0.5}, {}, "delay_frames must be at least 1"),
    ],
)
def test_telemetry_that_is_refused(telemetry_changes, options, words):
    with pytest.raises(lbt.errors.ProblemError, match=words):
        lbt.load_record(telemetry(**telemetry_changes), **options)


def test_what_telemetry_does_not_tell_is_given():
    seen = lbt.load_record(
        telemetry(measurement_unit="px", command_unit="V", delay_frames=None),
        delay_frames=2.5,
        diameter_m=8.0,
        unit="mas",
        command_unit="nm",
    )
    assert seen.delay_frames == 2.5
    assert np.allclose(seen.measurements, lbt.models.nm_per_mas(8.0) * telemetry().measurements)
    assert np.array_equal(seen.commands, telemetry().commands)
    # a unit of the measurements is none of commands that have their own
    half = telemetry(measurement_unit="px", command_unit="nm")
    seen = lbt.load_record(half, unit="m")
    assert np.allclose(seen.measurements, 1e9 * half.measurements)
    assert np.array_equal(seen.commands, half.commands)
    other = lbt.load_record(telemetry(diameter_m=8.0), delay_frames=3, diameter_m=6.5)
    assert (other.delay_frames, other.diameter_m) == (3.0, 6.5)
    assert "delay_frames 3 was given; the telemetry has 2" in other.health.notes
