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
    control = lbt.kalman(axis_plant).controller
    run = lbt.simulate(control, lbt.Truth(turbulence=None), hardware=path, frames=5)
    other, two = (lbt.LoopHardware(frame_rate_hz=f, modes=m) for f, m in ((500, 1), (800, 2)))
    for given, options, words in (
        ((run, path), {"case": 1}, "case must be below the number of cases, 1; got 1"),
        ((run, other), {}, "must be that of the simulation, at 800 Hz"),
        ((3, path), {}, "expected a Simulation; got int"),
        ((run, 3), {}, "expected a LoopHardware; got int"),
        ((run, path), {"design": control}, "expected a Design; got Controller"),
    ):
        with pytest.raises(ProblemError, match=words):
            lbt.files.telemetry_from_simulation(*given, **options)
    words = "interaction_matrix must have 1 measurement to match measurements"
    with pytest.raises(DimensionError, match=words):
        lbt.files.telemetry_from_simulation(run, two)
