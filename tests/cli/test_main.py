"""The command line as a user meets it: bad input, exit codes, help, imports."""

import json
import os
import re
import subprocess
import sys

import pytest
from support.commands import run
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.cli import main as command_line
from lbt_synth.cli.arguments import COMMANDS, build_parser

CONFIG = str(LBT_YAML)


STATUS = {lbt.errors.SynthesisError: 1, lbt.errors.LbtSynthError: 2}
ERRORS = [kind for kind in vars(lbt.errors).values() if isinstance(kind, type)]
ERRORS = [kind for kind in ERRORS if issubclass(kind, lbt.errors.LbtSynthError)]


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_an_error_is_a_status_and_a_line(capsys, monkeypatch, more):
    def fails(*_):
        raise kind("some_name must\nbe 1.", in_python="Do.", at_terminal="Try it.")

    monkeypatch.setattr("lbt_synth.cli.design.load_with_digest", fails)
    for kind in ERRORS:
        status, text, error = run(capsys, "show", "a.fits", *more)
        assert status == next(code for base, code in STATUS.items() if issubclass(kind, base))
        assert error == "lbt-synth: error: some_name must\\nbe 1. Try it.\n"
        said = {"error": kind.__name__, "message": "some_name must\nbe 1. Try it."}
        assert text == (json.dumps(said) + "\n" if more else "")


@pytest.mark.parametrize(
    ("arguments", "expected", "text"),
    [
        ("design CONFIG --method kalman --gamma 200 -o OUT.fits", 2, "gamma goes with method hinf"),
        ("design CONFIG --method integrator --gain 1.5 -o OUT.fits", 1, "failed its certificate"),
        ("design CONFIG --method magic -o OUT.fits", 2, "invalid choice"),
        ("design CONFIG", 2, "required"),
        ("plot sigma DAMAGED.fits -o OUT.png", 2, "damaged"),
        ("simulate CONFIG none.fits --frames many", 2, "invalid int"),
    ],
)
def test_bad_input_writes_nothing(tmp_path, capsys, monkeypatch, gains, arguments, expected, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    words = [CONFIG if word == "CONFIG" else word for word in arguments.split()]
    status, out, error = run(capsys, *words)
    assert (status, out) == (expected, "")
    assert text in error
    assert os.listdir(tmp_path) == ["DAMAGED.fits"]


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "lbt_synth", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"lbt-synth {lbt.__version__}\n"


def test_no_words_are_a_question_for_help(capsys):
    assert run(capsys) == run(capsys, "--help")


def test_the_module_of_every_command_names_it():
    for command in COMMANDS:
        module = sys.modules[command_line._find_command(command).__module__]
        title = module.__doc__.splitlines()[0]
        assert title.startswith("The command")
        assert command in re.split(r"[,:.]? ", title), command


def test_shells_complete_every_option():
    names = {}
    for parser in (build_parser("tradeoff"), build_parser()):
        (commands,) = parser._subparsers._group_actions
        assert list(commands.choices) == list(COMMANDS)
        for command, own in commands.choices.items():
            names.setdefault(command, []).append(set(own._option_string_actions))
    short, full = names["tradeoff"]
    assert short == full >= {"--json", "--points", "--taps", "-o", "--output"}
    short, full = names["study"]
    assert short == {"-h", "--help", "--json", "--verbose"}
    assert full > short | {"--jobs", "--dask", "--row"}


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("tradeoff", "the Kalman filter's (default 9)"),
        ("identify", "counts as turbulence [Hz] (default 3)"),
    ],
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
        "from lbt_synth.cli.arguments import build_parser; build_parser('').format_help()",
    ],
)
def test_imports_are_quick(code):
    """Nothing heavier than the standard library before a name is used."""
    heavy = {"cvxpy", "control", "matplotlib", "astropy", "scipy"}
    heavy |= {"pydantic", "rich", "numpy", "bokeh", "jinja2"}
    assert not heavy & loaded_after(code)


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_a_design_of_one_sensor_loads_what_it_uses(tmp_path, method):
    """What a design does not need took half of its time."""
    ours = "design.loop_shaping design.modal design.shaping.solution design.mixed design.lqg "
    ours += "linear.output_feedback loop.simulation interop config.end_to_end studies.study "
    ours += "studies.robustness report.figures report.page identification.fit "
    ours += "identification.records"
    unused = {f"lbt_synth.{name}" for name in ours.split()} | {"scipy.stats", "scipy.signal"}
    unused |= {"control", "matplotlib", "bokeh", "jinja2", "weasyprint"}
    if method == "hinf":  # its inequalities are stated in cvxpy
        unused -= loaded_after("import cvxpy")
    words = ["design", str(LBT_YAML), "--method", method, "-o", str(tmp_path / "d.fits")]
    loaded = loaded_after(f"from lbt_synth.cli.main import main; main({words})")
    assert "lbt_synth.design.certificate" in loaded
    assert not unused & loaded
    assert ("cvxpy" in loaded) is (method == "hinf")


def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(monkeypatch):
    """Two threads on two busy cores made a design of 5 s take a minute."""
    name, seen = "OPENBLAS_NUM_THREADS", []
    monkeypatch.setattr(command_line, "main", lambda: seen.append(os.environ[name]) or 0)
    for threads in ("3", None):
        monkeypatch.setenv(name, "3")
        if threads is None:
            monkeypatch.delenv(name)
        with pytest.raises(SystemExit):
            command_line.entry_point()
        assert os.environ.get(name) == threads
    assert seen == ["3", "1"]


def test_the_console_script_survives_a_closed_pipe():
    script = f"{sys.executable} -m lbt_synth.cli.main design --help | head -1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


SAID = {
    "design CONFIG --method hinf --gamma 1 -o OUT.fits": "at least 155.* Try --gamma-ratio 1.2.",
    "simulate CONFIG GAIN --sensor-gain 0": "--sensor-gain must be above 0",
    "end-to-end CONFIG GAIN -o OUT --pixels 11": "--pixels must be even, at least subapertures_",
    "identify BARE.csv -o OUT.yaml": "measurements=... commands=..., by names or numbers from 0",
    "identify NAMED.csv -o OUT.yaml": "unit of tip, tilt, command_tip, command_tilt: give --unit "
    ".*; the frame rate: give --frame-rate-hz, or times .*; the total delay: give --delay-frames.",
    "identify NIGHT --unit mas -o OUT.yaml": "--unit must be that of the data, 'nm'; got 'mas'. "
    "Leave it out; --show-unit is the unit",
}


@pytest.mark.parametrize("words", SAID)
def test_an_error_names_options_and_files(
    tmp_path, capsys, monkeypatch, gains, recorded_night, words
):
    monkeypatch.chdir(tmp_path)
    rows = "1.0,2.0,0.5,0.25\n2.0,1.0,0.25,0.5\n" * 100
    (tmp_path / "BARE.csv").write_text(rows)
    (tmp_path / "NAMED.csv").write_text("tip,tilt,command_tip,command_tilt\n" + rows)
    places = {"CONFIG": LBT_YAML, "GAIN": gains["kalman"], "NIGHT": recorded_night}
    status, out, error = run(capsys, *(places.get(word, word) for word in words.split()))
    assert (status, out, error.count("\n")) == (1 if "--gamma" in words else 2, "", 1)
    assert re.search(SAID[words], error)


def test_in_python_arguments_keep_their_names():
    plant = lbt.load_config(LBT_YAML).plant
    with pytest.raises(lbt.errors.InfeasibleError, match=r"must be .* Try gamma_ratio=1\.2\."):
        lbt.hinf(plant, gamma=1.0)
