"""The command line as a user meets it: bad input, exit codes, help, imports."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.identified_models import ONE_AXIS, TWO, save_identified
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli import main as command_line
from lbt_synth.cli.arguments import COMMANDS, build_parser
from lbt_synth.cli.main import main
from lbt_synth.config.schema import FileSection

CONFIG = str(LBT_YAML)


BAD = [
    ("design CONFIG --method hinf --gamma 10 -o OUT.fits", 1, "at least 15"),
    ("design CONFIG --method kalman --gamma 200 -o OUT.fits", 2, "goes with --method hinf"),
    ("design CONFIG --method integrator --gain 1.5 -o OUT.fits", 1, "failed its certificate"),
    ("design CONFIG --method kalman -o OUT.txt", 2, "must end in .fits"),
    ("design CONFIG --method magic -o OUT.fits", 2, "invalid choice"),
    ("design CONFIG", 2, "required"),
    ("show none.fits", 2, "cannot read none.fits"),
    ("plot sigma DAMAGED.fits -o OUT.png", 2, "damaged"),
    ("simulate CONFIG KALMAN --frames many", 2, "invalid int"),
    ("paper -o FILE", 2, "cannot make the directory"),
    ("frobnicate", 2, "invalid choice"),
]


@pytest.mark.parametrize(("arguments", "expected", "text"), BAD)
def test_bad_input(tmp_path, capsys, monkeypatch, gains, arguments, expected, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    (tmp_path / "FILE").write_text("")
    before = sorted(os.listdir(tmp_path))
    files = {"CONFIG": CONFIG, "KALMAN": gains["kalman"]}
    status, out, error = run(capsys, *(files.get(word, word) for word in arguments.split()))
    assert status == expected
    assert out == ""
    assert text in error
    assert "Traceback" not in error
    assert sorted(os.listdir(tmp_path)) == before  # nothing half-written


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "lbt_synth", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"lbt-synth {lbt.__version__}\n"


def test_one_line_an_error(capsys):
    _, _, error = run(capsys, "show", "none.fits")
    assert error.startswith("lbt-synth: error: ")
    assert error.count("\n") == 1


def test_version_and_help(capsys):
    assert run(capsys, "--version")[1] == f"lbt-synth {lbt.__version__}\n"
    status, text, _ = run(capsys, "--help")
    assert status == 0
    assert run(capsys) == (0, text, "")
    for command in ("design", "show", "verify", "plot", "simulate", "robustness", "paper"):
        assert command in text


@pytest.mark.parametrize("command", COMMANDS)
def test_the_module_of_every_command_names_it(command):
    run = command_line._find_command(command)
    title = sys.modules[run.__module__].__doc__.splitlines()[0]
    assert title.startswith("The command")
    assert command in title.replace(",", " ").replace(":", " ").replace(".", " ").split()


def test_shells_complete_every_option():
    names = {}
    for parser in (build_parser("tradeoff"), build_parser(*COMMANDS)):
        (commands,) = parser._subparsers._group_actions
        assert list(commands.choices) == list(COMMANDS)
        for command, own in commands.choices.items():
            names.setdefault(command, []).append(set(own._option_string_actions))
    short, full = names["tradeoff"]
    assert short == full >= {"--json", "--points", "--taps", "-o", "--output"}
    short, full = names["study"]
    assert short == {"-h", "--help", "--json", "--verbose"}
    assert full > short | {"--jobs", "--dask", "--dry-run", "--row"}


@pytest.mark.parametrize(
    ("command", "text"),
    [("tradeoff", "the Kalman filter's (default 9)"), ("identify", "[Hz] (default 0.1)")],
)
def test_help_says_the_defaults(capsys, command, text):
    status, out, _ = run(capsys, command, "--help")
    assert status == 0
    assert text in " ".join(out.split())


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
        "from lbt_synth.cli.arguments import build_parser; build_parser().format_help()",
    ],
)
def test_imports_are_quick(code):
    """Nothing heavier than the standard library before a name is used."""
    heavy = {"cvxpy", "control", "matplotlib", "astropy", "scipy"}
    heavy |= {"pydantic", "rich", "numpy", "bokeh", "jinja2"}
    assert not heavy & loaded_after(code)


def test_designing_needs_no_solver_that_it_does_not_use():
    code = (
        "import lbt_synth as lbt\n"
        "p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)\n"
        "lbt.kalman(p)"
    )
    assert not {"cvxpy", "control", "matplotlib", "astropy"} & loaded_after(code)


def loaded_by_command(*words):
    """Modules in memory after a command ran."""
    return loaded_after(f"from lbt_synth.cli.main import main; main({[str(w) for w in words]})")


@pytest.mark.parametrize("method", ["kalman", "hinf", "integrator"])
def test_a_design_of_one_sensor_loads_what_it_uses(tmp_path, method):
    """What a design does not need took half of its time."""
    ours = (
        *("design.loop_shaping", "design.modal", "design.shaping.solution"),
        *("design.mixed", "design.lqg"),
        *(
            "linear.output_feedback",
            "loop.simulation",
            "interop",
            "config.end_to_end",
            "studies.study",
            "studies.robustness",
        ),
        *("report.figures", "report.page", "identification.fit", "identification.records"),
    )
    scipys = ("stats", "signal")
    unused = {f"lbt_synth.{name}" for name in ours} | {f"scipy.{name}" for name in scipys}
    unused |= {"control", "matplotlib", "bokeh", "jinja2", "weasyprint"}
    if method == "hinf":  # its inequalities are stated in cvxpy
        unused -= loaded_after("import cvxpy")
    loaded = loaded_by_command("design", LBT_YAML, "--method", method, "-o", tmp_path / "d.fits")
    assert "lbt_synth.design.certificate" in loaded
    assert not unused & loaded
    assert ("cvxpy" in loaded) is (method == "hinf")


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(monkeypatch, given, expected):
    """Two threads on two busy cores made a design of 5 s take a minute."""
    name = "OPENBLAS_NUM_THREADS"
    monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv(name, given)
    seen = []
    monkeypatch.setattr(command_line, "main", lambda: seen.append(os.environ[name]) or 0)
    with pytest.raises(SystemExit):
        command_line.entry_point()
    assert seen == [expected]
    assert os.environ.get(name) == given


def test_the_console_script_survives_a_closed_pipe():
    script = f"{sys.executable} -m lbt_synth.cli.main design --help | head -1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the device is Linux's own")
def test_output_that_cannot_be_written(gains):
    script = f"{sys.executable} -m lbt_synth.cli.main verify {gains['kalman']} > /dev/full"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "cannot write the output" in done.stderr


def checked_output(capsys, *arguments, expect=0):
    status = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert status == expect, err
    assert "Traceback" not in out + err
    return out if expect == 0 else err


def answer(capsys, *arguments):
    return json.loads(checked_output(capsys, *arguments, "--json"))


def test_commands_take_one_axis(tmp_path, capsys):
    """Two axes are in the tests of each command."""
    config = save_identified(tmp_path, ONE_AXIS)
    config.write_text(config.read_text() + "\nrobustness:\n  errors_hz: [0]\n")
    gain, integrator = tmp_path / "k.fits", tmp_path / "i.fits"
    made = answer(capsys, "design", config, "--method", "kalman", "-o", gain)
    assert made["above_limit_percent"] == pytest.approx(0, abs=1e-5)
    answer(capsys, "design", config, "--method", "integrator", "-o", integrator)
    hinf = ("--method", "hinf", "--route", "riccati", "-o", tmp_path / "h.fits")
    assert answer(capsys, "design", config, *hinf)["gamma"] < made["gamma"]
    lqg = answer(capsys, "design", config, "--method", "lqg", "-o", tmp_path / "l.fits")
    assert lqg["rms"] == pytest.approx(made["rms"], rel=1e-6)
    sigma = answer(capsys, "plot", "sigma", gain, integrator, "-o", tmp_path / "s.png")
    assert all(design["stable"] for design in sigma["designs"].values())
    few = ("--frames", "4000", "--cases", "2", "--telemetry", tmp_path / "t.fits")
    simulated = answer(capsys, "simulate", config, gain, *few, "-o", tmp_path / "sim.png")
    # the rms of a line is that of means in the model, and that of all moments in the truth
    assert simulated["residual_exact_nm"] == pytest.approx(made["residual_nm"], rel=1e-3)
    rms_nm = np.sqrt(np.mean(np.square(simulated["residual_nm"])))
    assert rms_nm == pytest.approx(made["residual_nm"], rel=0.1)
    assert "telescope" not in checked_output(capsys, "telemetry", tmp_path / "t.fits", "--verbose")
    limits = answer(capsys, "limits", config, integrator, "-o", tmp_path / "l.csv")
    assert limits["limit_nm"] > made["rms"]  # that is of means over frames
    rows = answer(capsys, "robustness", config, "-o", tmp_path / "r.png")
    best = {row["method"]: row for row in rows["rows"] if row["error_hz"] == 0}
    assert 1 <= best["kalman"]["residual_nm"] / limits["limit_nm"] < 1.001
    map_of = ("--errors-hz", "-0.1", "0.1", "3", "--sensor-gains", "0.79", "0.81", "3")
    mapped = answer(capsys, "robustness", config, gain, *map_of, "-o", tmp_path / "m.png")
    assert np.array(mapped["maps"]["k"]["strehl"]).shape == (1, 3, 3)
    front = ("--points", "2", "--taps", "2", "-o", tmp_path / "f.png")
    assert answer(capsys, "tradeoff", config, *front)["points"]
    for target, ending in {"c": "c", "matlab": "mat"}.items():
        checked_output(capsys, "export", gain, "-o", tmp_path / f"x.{ending}", "--for", target)


def test_commands_that_need_more_say_so(tmp_path, capsys):
    config = save_identified(tmp_path, TWO)
    error = checked_output(
        capsys, "modal", config, "--modes", "20", "-o", tmp_path / "m.png", expect=2
    )
    assert "the key atmosphere is missing" in error
    uneven = lbt.load_config(ROOT / "examples" / "lbt.yaml").settings.model_dump(exclude_unset=True)
    uneven["sensor"] = {"noise_nm": [15.5, 9.0]}
    lbt.config.save_config(tmp_path / "u.yaml", FileSection.model_validate(uneven))
    error = checked_output(capsys, "modal", tmp_path / "u.yaml", "-o", tmp_path / "m.png", expect=2)
    assert "sensor.noise_nm must be one number for hundreds of modes" in error
    error = checked_output(capsys, "mirror", config, "-o", tmp_path / "m.png", expect=2)
    assert "mirror.local_loop is missing" in error
    error = checked_output(
        capsys, "design", config, "--method", "robust", "-o", tmp_path / "m.fits", expect=2
    )
    assert "design.robust is missing" in error
    with pytest.raises(
        lbt.errors.ConfigError, match="the key telescope is missing: an end-to-end"
    ) as caught:
        _ = lbt.load_config(config).end_to_end
    assert caught.value.path == "telescope"


KNOWN = ("--unit", "nm", "--frame-rate-hz", "1000", "--delay-frames", "2")
SAID = [
    (
        ("design", "CONFIG", "--method", "hinf", "--gamma", "1", "-o", "OUT.fits"),
        ("--gamma must be at least 155", "Try --gamma-ratio 1.2."),
    ),
    (
        ("design", "CONFIG", "--method", "kalman", "--horizon", "200", "-o", "OUT.fits"),
        ("--horizon must leave the loop", "which makes 201.\n"),
    ),
    (("simulate", "CONFIG", "GAIN", "--sensor-gain", "0"), ("--sensor-gain must be above 0",)),
    (
        ("end-to-end", "CONFIG", "GAIN", "-o", "OUT", "--pixels", "11"),
        ("--pixels must be even, at least subapertures_across (30)",),
    ),
    (
        ("identify", "BARE.csv", "-o", "OUT.yaml"),
        ("Choose by --columns measurements=... commands=..., names",),
    ),
    (
        ("identify", "NAMED.csv", "-o", "OUT.yaml"),
        (
            "nothing tells the unit of tip, tilt, command_tip, command_tilt: give --unit (nm,",
            "; the frame rate: give --frame-rate-hz, or the times; the total delay: give "
            "--delay-frames.\n",
        ),
    ),
    (
        ("identify", "NIGHT", "--unit", "mas", "-o", "OUT.yaml"),
        (
            "--unit must be that of the data, 'nm'; got 'mas'. Leave it out; --show-unit is the unit",
        ),
    ),
]


@pytest.mark.parametrize(("words", "texts"), SAID, ids=lambda words: " ".join(words)[:40])
def test_an_error_names_options_and_files(
    tmp_path, capsys, monkeypatch, gains, recorded_night, words, texts
):
    monkeypatch.chdir(tmp_path)
    rows = "1.0,2.0,0.5,0.25\n2.0,1.0,0.25,0.5\n" * 100
    (tmp_path / "BARE.csv").write_text(rows)
    (tmp_path / "NAMED.csv").write_text("tip,tilt,command_tip,command_tilt\n" + rows)
    places = {"CONFIG": LBT_YAML, "GAIN": gains["kalman"], "NIGHT": recorded_night}
    status, out, error = run(capsys, *(places.get(word, word) for word in words))
    assert (status, out, error.count("\n")) == (1 if {"--gamma", "--rms"} & {*words} else 2, "", 1)
    for text in texts:
        assert text in error


def test_in_python_arguments_keep_their_names():
    plant = lbt.load_config(LBT_YAML).plant
    with pytest.raises(
        lbt.errors.InfeasibleError, match=r"gamma must be .* Try gamma_ratio=1\.2\."
    ):
        lbt.hinf(plant, gamma=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="make an EstimationProblem"):
        lbt.kalman(plant, horizon=200)
