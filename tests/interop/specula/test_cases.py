"""Cases of an end-to-end simulation, and their runs."""

import json
from dataclasses import replace

from support.drifting import drifting
from support.plants import LBT_YAML
from support.small_telescope import PLANT, SETUP, SHAKE, needs_specula

import lbt_synth as lbt
from lbt_synth.interop.specula.cases import _build_vibration, make_case, run_case


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


@needs_specula
def test_a_case_is_its_run(cache):
    setup = replace(SETUP, frames=60, settle_frames=200, vibrations=(SHAKE,), seed=5)
    design = lbt.kalman(PLANT)
    direct = setup.run(design, cache=cache)
    case = json.loads(json.dumps(make_case(setup, design.controller, vibrations=(SHAKE,), seed=5)))
    result = run_case(case, cache=cache)
    assert result["strehl"] == direct.strehl
    assert result["tip_rms_nm"] == float(direct.rms_nm[0])
    shake = lbt.Vibration(frequency_hz=30, damping=0.05, rms_nm=10.0)
    case = json.loads(json.dumps(make_case(setup, None, vibrations=[shake], seed=5)))
    run = replace(setup, vibrations=(shake,)).run(None, cache=cache)
    assert run_case(case, cache=cache)["tip_rms_nm"] == float(run.rms_nm[0])


def test_a_case_keeps_a_drifting_vibration():
    setup = lbt.load_config(LBT_YAML).end_to_end
    line = drifting(direction=(1, 0), damping=0.01)
    case = json.loads(json.dumps(make_case(setup, None, vibrations=[line])))
    assert _build_vibration(case["vibrations"][0]) == line
