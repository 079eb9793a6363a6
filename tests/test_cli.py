"""The command line, as a user meets it: good input, bad input, exit codes, JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli.main import main

CONFIG = str(LBT_YAML)


def run(capsys, *arguments):
    """Exit status, standard output and standard error of one command."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:  # argparse
        status = stop.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gains")
    config = lbt.load_config(CONFIG)
    designs = {
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2),
        "integrator": lbt.integrator(config.hardware, gain=0.5),
    }
    return {name: lbt.save_gain(folder / f"{name}.fits", d) for name, d in designs.items()}


@pytest.mark.parametrize(
    ("options", "method"),
    [
        (("--method", "kalman"), "kalman"),
        (("--method", "kalman", "--route", "sdp"), "kalman"),
        (("--method", "hinf", "--gamma-ratio", 1.2), "hinf"),
        (("--method", "hinf", "--gamma", 200, "--route", "riccati"), "hinf"),
        (("--method", "integrator"), "integrator"),
        (("--method", "integrator", "--gain", 0.4), "integrator"),
    ],
)
def test_design(tmp_path, capsys, options, method):
    out = tmp_path / "g.fits"
    status, text, error = run(capsys, "design", CONFIG, *options, "-o", out)
    assert (status, error) == (0, "")
    assert lbt.load_gain(out).method == method
    assert "Certificate" in text
    assert "modulus margin" in text


def test_default_ratio_comes_from_the_configuration(tmp_path, capsys):
    status, text, _ = run(
        capsys, "design", CONFIG, "--method", "hinf", "-o", tmp_path / "g.npz", "--json"
    )
    data = json.loads(text)
    assert status == 0
    assert data["gamma_requested"] / data["gamma_least"] == pytest.approx(1.2)
    assert data["gamma"] <= data["gamma_requested"]


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_show_and_verify(capsys, gains, name):
    status, text, _ = run(capsys, "show", gains[name], "--matrices")
    assert status == 0
    assert "stable sensor gains, from" in text
    status, text, _ = run(capsys, "show", gains[name], "--json", "--matrices")
    data = json.loads(text)
    assert status == 0
    assert data["margins"]["modulus"] > 0
    status, text, _ = run(capsys, "verify", gains[name])
    assert status == 0
    assert "verified" in text
    assert json.loads(run(capsys, "verify", gains[name], "--json")[1])["passed"] is True


def test_verification_that_fails_has_status_1(tmp_path, capsys, monkeypatch, gains):
    design = lbt.load_gain(gains["kalman"])
    honest = type(design).recertified

    def strict(self):
        found = honest(self)
        checks = tuple(
            lbt.design.Check(
                name=c.name, value=c.limit + 1, limit=c.limit, computed_by=c.computed_by
            )
            for c in found.checks
        )
        return lbt.design.Certificate(
            checks=checks, gamma=found.gamma, rms_per_output=found.rms_per_output
        )

    monkeypatch.setattr(type(design), "recertified", strict)
    status, text, _ = run(capsys, "verify", gains["kalman"])
    assert status == 1
    assert "NOT VERIFIED" in text


def test_sigma(tmp_path, capsys, gains):
    out = tmp_path / "sigma.pdf"
    status, text, _ = run(capsys, "sigma", *gains.values(), "-o", out)
    assert status == 0
    assert out.read_bytes().startswith(b"%PDF")
    assert "norm [nm]" in text  # units survive the table
    data = json.loads(run(capsys, "sigma", gains["hinf"], "-o", out, "--json")[1])
    assert data["designs"]["hinf"]["stable"] is True


def test_simulate(tmp_path, capsys, gains):
    out = tmp_path / "run.png"
    arguments = ("simulate", CONFIG, gains["kalman"], "--frames", 2000, "--cases", 2)
    status, text, _ = run(capsys, *arguments, "-o", out)
    assert status == 0
    assert "Strehl ratio" in text
    assert out.exists()
    data = json.loads(run(capsys, *arguments, "--json")[1])
    assert len(data["strehl"]) == 2
    assert data["strehl_exact"] == pytest.approx(0.836, abs=0.002)
    again = json.loads(run(capsys, *arguments, "--json")[1])
    assert again == data  # seeds make runs repeatable
    dim = json.loads(run(capsys, *arguments, "--json", "--sensor-gain", 0.4)[1])
    assert dim["sensor_gain"] == 0.4
    assert dim["strehl_exact"] < data["strehl_exact"]


def test_robustness(tmp_path, capsys):
    table, figure = tmp_path / "r.csv", tmp_path / "r.png"
    status, text, _ = run(capsys, "robustness", CONFIG, "-o", table, "-o", figure)
    assert status == 0
    assert "error [Hz]" in text
    lines = table.read_text().splitlines()
    assert lines[0].startswith("error_hz,method,strehl,residual_nm")
    assert len(lines) == 31
    assert figure.exists()


def test_paper(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "a" / "b")
    assert status == 0
    assert "Table III" in text
    assert "fitted" in text
    assert (tmp_path / "a" / "b" / "table_iii.csv").exists()


def test_an_unstable_loop_has_status_1(capsys, gains):
    status, out, error = run(
        capsys, "simulate", CONFIG, gains["hinf"], "--sensor-gain", 0.3, "--json"
    )
    assert status == 1
    assert json.loads(out)["error"] == "UnstableLoopError"
    assert "the closed loop must be stable" in error


BAD = [
    (("design", CONFIG, "--method", "hinf", "--gamma", "10", "-o", "OUT.fits"), 1, "at least 15"),
    (("design", CONFIG, "--method", "hinf", "--gamma", "nan", "-o", "OUT.fits"), 2, "finite"),
    (
        ("design", CONFIG, "--method", "hinf", "--gamma-ratio", "0.5", "-o", "OUT.fits"),
        2,
        "at least 1",
    ),
    (
        ("design", CONFIG, "--method", "kalman", "--gamma", "200", "-o", "OUT.fits"),
        2,
        "goes with --method hinf",
    ),
    (
        ("design", CONFIG, "--method", "kalman", "--route", "lmi", "-o", "OUT.fits"),
        2,
        "takes riccati or sdp",
    ),
    (
        ("design", CONFIG, "--method", "kalman", "--gain", "0.5", "-o", "OUT.fits"),
        2,
        "goes with --method integrator",
    ),
    (
        ("design", CONFIG, "--method", "integrator", "--gain", "1.5", "-o", "OUT.fits"),
        1,
        "failed its certificate",
    ),
    (("design", CONFIG, "--method", "kalman", "-o", "OUT.txt"), 2, "must end in .fits"),
    (("design", CONFIG, "--method", "kalman", "-o", "none/OUT.fits"), 2, "cannot write"),
    (("design", "none.yaml", "--method", "kalman", "-o", "OUT.fits"), 2, "cannot read none.yaml"),
    (("design", CONFIG, "--method", "magic", "-o", "OUT.fits"), 2, "invalid choice"),
    (("design", CONFIG), 2, "required"),
    (("show", "none.fits"), 2, "cannot read none.fits"),
    (("show", CONFIG), 2, "must end in"),
    (("verify", "DAMAGED.fits"), 2, "damaged"),
    (("sigma", "DAMAGED.fits", "-o", "OUT.png"), 2, "damaged"),
    (("sigma", "KALMAN", "-o", "OUT.gif"), 2, "must end in .png"),
    (("sigma", "KALMAN", "KALMAN", "-o", "OUT.png"), 2, "given once"),
    (("sigma", "KALMAN", "--sensor-gain", "-1", "-o", "OUT.png"), 2, "above 0"),
    (("simulate", CONFIG, "KALMAN", "--frames", "0"), 2, "at least 1"),
    (("simulate", CONFIG, "KALMAN", "--frames", "many"), 2, "invalid int"),
    (("simulate", CONFIG, "KALMAN", "-o", "OUT.doc"), 2, "must end in .png"),
    (("robustness", CONFIG, "-o", "OUT.xls"), 2, "must end in .csv"),
    (("robustness", CONFIG, "--gamma-ratio", "nan"), 2, "finite"),
    (("design", CONFIG, "--method", "hinf", "--gamma", "1e300", "-o", "OUT.fits"), 2, "at most"),
    (("simulate", CONFIG, "KALMAN", "--frames", "99999999999999"), 2, "must fit into"),
    (("simulate", CONFIG, "KALMAN", "-o", "none/OUT.png"), 2, "no directory none"),
    (("robustness", CONFIG, "-o", "OUT.csv", "-o", "none/OUT.png"), 2, "no directory none"),
    (("paper", "-o", "FILE"), 2, "cannot make the directory"),
    (("frobnicate",), 2, "invalid choice"),
    ((), 2, "required"),
]


@pytest.mark.parametrize(("arguments", "expected", "text"), BAD)
def test_bad_input(tmp_path, capsys, monkeypatch, gains, arguments, expected, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    (tmp_path / "FILE").write_text("")
    before = sorted(os.listdir(tmp_path))
    arguments = [str(gains["kalman"]) if a == "KALMAN" else a for a in arguments]
    status, out, error = run(capsys, *arguments)
    assert status == expected
    assert out == ""
    assert text in error
    assert "Traceback" not in error
    assert sorted(os.listdir(tmp_path)) == before  # nothing half-written


def test_one_line_an_error(capsys):
    _, _, error = run(capsys, "show", "none.fits")
    assert error.startswith("lbt-synth: error: ")
    assert error.count("\n") == 1


def test_version_and_help(capsys):
    assert run(capsys, "--version")[1] == f"lbt-synth {lbt.__version__}\n"
    status, text, _ = run(capsys, "--help")
    assert status == 0
    for command in ("design", "show", "verify", "sigma", "simulate", "robustness", "paper"):
        assert command in text


def loaded_after(code):
    """Modules in memory after a fresh interpreter ran some code."""
    script = f"{code}\nimport sys\nprint('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "code",
    [
        "import lbt_synth",
        "from lbt_synth.cli.main import build_parser; build_parser().format_help()",
    ],
)
def test_imports_are_quick(code):
    """Nothing heavier than the standard library before a name is used."""
    heavy = {
        "cvxpy",
        "control",
        "matplotlib",
        "astropy",
        "scipy",
        "pydantic",
        "rich",
        "numpy",
        "bokeh",
        "jinja2",
    }
    assert not heavy & loaded_after(code)


def test_designing_needs_no_solver_that_it_does_not_use():
    code = (
        "import lbt_synth as lbt\n"
        "p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)\n"
        "lbt.kalman(p)"
    )
    assert not {"cvxpy", "control", "matplotlib", "astropy"} & loaded_after(code)


def test_the_console_script_survives_a_closed_pipe():
    script = f"{sys.executable} -m lbt_synth.cli.main design --help | head -1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


def test_a_controller_for_another_loop_gets_a_note(tmp_path, capsys, gains):
    text = LBT_YAML.read_text().replace("delay_frames: 2.0", "delay_frames: 2.4")
    (tmp_path / "other.yaml").write_text(text)
    status, out, _ = run(
        capsys, "simulate", tmp_path / "other.yaml", gains["kalman"], "--frames", 500, "--cases", 1
    )
    assert status == 0
    assert "note: designed for a delay of 2 frames, run with 2.4." in out
    assert "scatter" not in out  # one run has none
    assert "1 run of 500 frames" in out


def test_a_small_margin_gets_a_note(tmp_path, capsys):
    _, out, _ = run(capsys, "design", CONFIG, "--method", "integrator", "-o", tmp_path / "i.fits")
    assert "note: the modulus margin 0.0751 is small" in out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the device is Linux's own")
def test_output_that_cannot_be_written(gains):
    script = f"{sys.executable} -m lbt_synth.cli.main verify {gains['kalman']} > /dev/full"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "cannot write the output" in done.stderr
