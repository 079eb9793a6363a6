"""The command line as a user meets it: refusals, exit codes, help, imports."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from support.commands import run
from support.configs import minimal_config, write_config
from support.drifting import drift_file
from support.night import simulated_night
from support.plants import LBT_YAML
from support.predictors import made
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.cli import main as command_line
from lbt_synth.cli.arguments import COMMANDS, build_parser

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


@pytest.fixture(scope="module")
def places(tmp_path_factory, gains, recorded_night, sensors_config, sensors_file):
    folder = tmp_path_factory.mktemp("places")
    lbt_text, rows = LBT_YAML.read_text(), "1.0,2.0,0.5,0.25\n2.0,1.0,0.25,0.5\n" * 100
    noise = re.sub(r"(?s)  pyramid:.*?(?=mirror:)", "  noise_nm: [12.0, 9.0]\n\n", lbt_text)
    texts = {
        "BARE.csv": rows,
        "NAMED.csv": "tip,tilt,command_tip,command_tilt\n" + rows,
        "SPECTRUM.csv": "frequency_hz,psd\n" + "".join(f"{i},1\n" for i in range(1, 99)),
        "UNEVEN.yaml": noise,
        "WITHOUT.yaml": re.sub(r"mirror:\n  modes", "mirror: {}\n  # modes", noise),
    }
    for name, content in texts.items():
        (folder / name).write_text(content)
    (folder / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    run, _, ran = simulated_night()
    y, u = run.measurements[0, :3000], run.commands[0, :3000]
    np.savez(folder / "SHORT.npz", measurements=y, commands=u)
    lbt.save_gain(folder / "STALE.fits", replace(ran, configuration='{"version": 3}'))
    lbt.save_gain(folder / "PREDICTOR.fits", made(residual_nm=106.2, alone_nm=167.4))
    drift_file(folder).rename(folder / "DRIFT.yaml")
    names = {path.stem: path for path in folder.iterdir()}
    names |= {name.upper(): path for name, path in gains.items()}
    names |= {"CONFIG": LBT_YAML, "NIGHT": recorded_night}
    names |= {"SENSORS": sensors_file, "SEVERAL": sensors_config.source}
    return names | {"FIXED": write_config(folder, minimal_config())}


FACTS = "--frame-rate-hz 1000 --delay-frames 2 --unit nm"
SLOWER = "must run at the configuration's 800 Hz; got a design for"
UNIT = "a wavefront is shown in mas by the telescope's diameter, which is not known here"
STILL = r"PREDICTOR.fits reads a, ..., which nothing in the truth of lbt.yaml moves; .* shows 106 "
FAILED = {
    "design CONFIG --method integrator --gain 1.5 -o k.fits": "failed its certificate",
    "design CONFIG --method hinf --gamma 1 -o k.fits": "at least 155.* Try --gamma-ratio 1.2.",
    "simulate CONFIG HINF --sensor-gain 0.3": "the closed loop must be stable",
    "plot bode INTEGRATOR --gain-factor 3 -o b.csv": "no loop is stable at 3 times the sensor gain",
    "plot step INTEGRATOR --gain-factor 3 -o b.csv": "no loop is stable at 3 times the sensor gain",
}
WRONG = {
    "design CONFIG --method kalman --gamma 200 -o k.fits": "gamma goes with method hinf",
    "design CONFIG --method magic -o k.fits": "invalid choice",
    "design CONFIG": "required",
    "design CONFIG --method predictor -o q.fits": "alone. Try lbt-synth auto RECORD --method pred",
    "limits": "required: config .see",  # what can be left out is not called required
    "limits CONFIG --frame-rates 900 300": "--frame-rates must be LOW below HIGH; got 900 300",
    "limits CONFIG --frame-rates 0 300": "--frame-rates must be above 0; got 0",
    "limits CONFIG --frame-rates 30 300": "at 30 Hz: .*below the Nyquist frequency 15 Hz",
    "limits CONFIG KALMAN --frame-rates 300 900": "leave the gain files out",
    "limits FIXED --frame-rates 300 900": "kind ar is known at 800 Hz alone. Give an atmosphere",
    "limits DRIFT KALMAN": "drifts from 17 to 23 Hz",
    "robustness DRIFT KALMAN": "drifts from 17 to 23 Hz",
    "robustness CONFIG KALMAN --errors-hz -1 1 2.5": "COUNT of at least 2; got -1 1 2.5",
    "robustness CONFIG KALMAN --sensor-gains 0 1 3": "--sensor-gains must be above 0",
    "robustness CONFIG KALMAN KALMAN": "each gain file must have a name",
    "compare CONFIG PREDICTOR": STILL,
    "modal UNEVEN": "sensor.noise_nm must be one number for hundreds of modes",
    "modal WITHOUT": "the key mirror.modes is missing",
    "mirror CONFIG": "mirror.local_loop is missing",
    "tradeoff CONFIG --points 1": "--points must be at least 2",
    "simulate CONFIG none.fits --frames many": "invalid int",
    "simulate CONFIG PREDICTOR": STILL,
    "simulate CONFIG KALMAN --sensor-gain 0": "--sensor-gain must be above 0",
    "simulate CONFIG KALMAN --spectrum a.csv": "a spectrum must end in .fits; got 'a.csv'",
    "simulate CONFIG KALMAN --telemetry t.txt": "telemetry must end in",
    "simulate CONFIG KALMAN HINF --spectrum a.fits": "--spectrum goes with one gain file; got 2",
    "simulate CONFIG KALMAN HINF --telemetry a.fits": "goes with one gain file; got 2.",
    "simulate CONFIG KALMAN HINF -o a.png": "goes with one gain file; got 2.",
    "simulate SEVERAL SENSORS --drop m2": "--drop takes SENSOR@START..END",
    "simulate SEVERAL SENSORS --drop m2@5s --frames 1000": "--frames must reach beyond",
    "simulate SEVERAL SENSORS --stroke 100": "goes with a design of the loop's own sensor",
    "simulate SEVERAL KALMAN --drop m2@1s": "--drop goes with a design of several sensors",
    "plot sigma SENSORS": "is a design of several sensors",
    "plot sigma DAMAGED -o s.png": "damaged",
    "show KALMAN --unit mas": UNIT,
    "show STALE": "error: the configuration in .*STALE.fits: ",
    "report CONFIG KALMAN -o x.pdf": "a page must end in .html; got 'x.pdf'",
    "report CONFIG KALMAN -o x.html --title ": "--title must hold at least one letter",
    "report CONFIG KALMAN KALMAN -o x.html": "must have a name of its own",
    "report CONFIG STALE -o x.html": SLOWER,
    "explore CONFIG STALE": SLOWER,
    "explore CONFIG --port 70000": "--port must be at most 65535",
    "explore CONFIG --origin a\x07b:8": "--origin must be HOST:PORT, as localhost:8080; got",
    "explore CONFIG -o nowhere": "no directory nowhere",
    "export KALMAN --for matlab -o k.mat --name x": "--name goes with --for c",
    "export KALMAN --for cacao -o k.mat": "must end in .fits",
    "rehearse none.npz SENSORS --for c": "is a design of several sensors",
    "telemetry SPECTRUM --unit nm^2/Hz": "telemetry holds recorded series; got a spectrum",
    "telemetry KALMAN": "Choose by --columns measurements=",
    "telemetry NIGHT -o t.txt": "must end in .fits, .npz or .aot.fits",
    "telemetry NIGHT --loop 1": "loop chooses a control loop of a file of the AOT standard; this is",
    "identify BARE -o m.yaml": r"measurements=\.\.\. commands=\.\.\., by names or numbers from 0",
    "identify NAMED -o m.yaml": "unit of tip, tilt, command_tip, command_tilt: give --unit .*; the "
    "frame rate: give --frame-rate-hz, or times .*; the total delay: give --delay-frames.",
    "identify NIGHT -o m.txt": "must end in .yaml",
    "identify NIGHT -o m.yaml --columns a": "--columns takes ROLE=NAME or ROLE=NAME,NAME",
    "identify NIGHT -o m.yaml --acceleration-unit g": "goes with --accelerometers.",
    "identify NIGHT -o m.yaml --obstruction 0.1": "give --diameter-m.",
    "identify NIGHT -o m.yaml --unit mas": "--unit must be that of the data, 'nm'; got 'mas'. "
    "Leave it out; --show-unit is the unit",
    f"auto SHORT -o t.fits {FACTS}": "4 s at 1000 Hz. in stretches of at least 256",
    f"auto SHORT NIGHT -o t.fits {FACTS}": "SHORT.npz: the record needs 4000 usable",
    "auto SPECTRUM --unit nm^2/Hz -o t.fits": "got a spectrum",
    "auto NIGHT NIGHT -o t.fits": "each record must have a name of its own; got ",
    "auto NIGHT SHORT --commands u -o t.fits": "--commands is for one record.",
    "diagnose NIGHT --pdf a.pdf": "--pdf is the page of -o on paper; give -o, too.",
    "diagnose SPECTRUM --unit nm^2/Hz": "diagnose examines recorded series; ",
    "end-to-end CONFIG KALMAN -o out --pixels 11": "--pixels must be even, at least subapertures_",
    "end-to-end CONFIG --tables II -o out --seeds 0": "--seeds must be at least 1",
    "end-to-end CONFIG --tables II -o out --seed -1": "--seed must be at least 0",
    "end-to-end CONFIG none.fits --tables II -o out": "cannot read none.fits: No such file",
}


@pytest.mark.parametrize("words", [*FAILED, *WRONG])
def test_a_refusal_is_one_line_and_writes_nothing(tmp_path, capsys, monkeypatch, places, words):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, *(places.get(word, word) for word in words.split(" ")))
    assert (status, out) == (1 if words in FAILED else 2, "")
    assert error.count("\n") == 1 or error.startswith("usage:"), error
    assert re.search((FAILED | WRONG)[words], error), error
    assert os.listdir() == []


def python(*words):
    options = {"capture_output": True, "text": True, "check": True}
    return subprocess.run([sys.executable, *words], **options).stdout


def test_the_package_runs_as_a_module_and_no_words_are_a_question_for_help(capsys):
    assert python("-m", "lbt_synth", "--version") == f"lbt-synth {lbt.__version__}\n"
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


def loaded_after(code):
    return {*python("-c", f"{code}\nimport sys\nprint('\\n'.join(sys.modules))").split()}


def test_imports_are_quick():
    """Nothing heavier than the standard library before a name is used."""
    heavy = {"cvxpy", "control", "matplotlib", "astropy", "scipy"}
    heavy |= {"pydantic", "rich", "numpy", "bokeh", "jinja2"}
    arguments = "from lbt_synth.cli.arguments import build_parser; build_parser('').format_help()"
    for code in ("import lbt_synth", arguments):
        assert not heavy & loaded_after(code)


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_a_design_of_one_sensor_loads_what_it_uses(tmp_path, method):
    """What a design does not need took half of its time."""
    ours = (
        "design.loop_shaping design.modal design.shaping.solution design.mixed design.lqg interop "
        "linear.output_feedback loop.simulation config.end_to_end studies.study identification.fit "
        "studies.robustness report.figures report.page identification.records"
    )
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
        refused(command_line.entry_point, SystemExit, None)
        assert os.environ.get(name) == threads
    assert seen == ["3", "1"]


def test_the_console_script_survives_a_closed_pipe():
    script = f"{sys.executable} -m lbt_synth.cli.main design --help | head -1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


def test_in_python_arguments_keep_their_names(config):
    words = r"must be .* Try gamma_ratio=1\.2\."
    refused(lambda: lbt.hinf(config.plant, gamma=1.0), lbt.errors.InfeasibleError, words)
