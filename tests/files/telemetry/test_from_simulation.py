"""Telemetry of a simulated loop."""

import pytest

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError


def test_the_camera_gives_telescope_and_strehl_ratio():
    path = lbt.LoopHardware(frame_rate_hz=800)
    design = lbt.integrator(path, gain=0.5)
    shake = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=200)
    truth = lbt.Truth(turbulence=None, vibrations=(shake,))
    run = lbt.simulate(design.controller, truth, hardware=path, frames=200, cases=2)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11)
    seen = lbt.files.telemetry_from_simulation(
        run, path, case=1, imaging=camera, name="a", metadata={"b": 1}
    )
    assert seen.strehl == run.strehl(camera)[1]
    assert (seen.diameter_m, seen.obstruction, seen.imaging_wavelength_um) == (8.22, 0.11, 2.2)
    assert (seen.name, dict(seen.metadata), seen.controller) == ("a", {"b": 1}, None)
    three = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    slow = lbt.integrator(three, gain=0.5).controller
    wide = lbt.simulate(slow, lbt.Truth(turbulence=None), hardware=three, frames=5)
    assert lbt.files.telemetry_from_simulation(wide, three, imaging=camera).strehl is None


def test_what_is_no_simulation_is_refused(axis_plant):
    path = axis_plant.hardware
    design = lbt.kalman(axis_plant)
    run = lbt.simulate(design.controller, lbt.Truth(turbulence=None), hardware=path, frames=5)
    with pytest.raises(ProblemError, match="case must be below the number of cases, 1; got 1"):
        lbt.files.telemetry_from_simulation(run, path, case=1)
    with pytest.raises(ProblemError, match="must be that of the simulation, at 800 Hz"):
        lbt.files.telemetry_from_simulation(run, lbt.LoopHardware(frame_rate_hz=500, modes=1))
    with pytest.raises(ProblemError, match="expected a Simulation; got int"):
        lbt.files.telemetry_from_simulation(3, path)
    with pytest.raises(ProblemError, match="expected a LoopHardware; got int"):
        lbt.files.telemetry_from_simulation(run, 3)
    with pytest.raises(ProblemError, match="expected a Design; got Controller"):
        lbt.files.telemetry_from_simulation(run, path, design=design.controller)
    with pytest.raises(
        DimensionError, match="interaction_matrix must have 1 measurement to match measurements"
    ):
        lbt.files.telemetry_from_simulation(run, lbt.LoopHardware(frame_rate_hz=800, modes=2))
