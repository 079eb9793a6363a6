"""Every command on the configuration of an identified system."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.identified_models import ONE_AXIS, TWO, save_identified
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.config.schema import FileSection


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
    config = save_identified(tmp_path, model)
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
    rows = answer(capsys, "robustness", config, "-o", tmp_path / "r.csv")
    best = {row["method"]: row for row in rows["rows"] if row["error_hz"] == 0}
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
    config = save_identified(tmp_path, TWO)
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
