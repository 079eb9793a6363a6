"""What commands print and write: tables, JSON, files."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.commands import refuse_commands, run_done
from support.configs import with_errors
from support.plants import LBT_YAML, ROOT

import lbt_synth as lbt
from lbt_synth.cli.arguments import COMMANDS
from lbt_synth.cli.output import Report, json_value
from lbt_synth.storage.rows import column, nm_column, table_row


@table_row
class Loop:
    """One loop."""

    name: str = column("loop")
    method: str = column("method")
    residual_nm: float = nm_column("residual", missing="unstable")


ROWS = [
    Loop(name="a", method="kalman", residual_nm=1234.56),
    Loop(name="long", method="hinf", residual_nm=np.nan),
]


def printed(capsys, report, **options):
    report.print(**options)
    return capsys.readouterr().out.splitlines()


def test_rows_and_facts_of_a_report(capsys):
    report = Report(data={"seed": 1})
    report.add_rows("loops", "All loops", ROWS)
    report.add_facts("One loop", ROWS[0], key="first")
    report.note_written("a.png", "b.csv")
    data = json.loads("".join(printed(capsys, report, as_json=True)))
    assert data["loops"][1] == {"name": "long", "method": "hinf", "residual_nm": None}
    assert data["first"]["residual_nm"] == 1234.56
    assert (data["units"], data["files"]) == ({"residual_nm": "nm"}, ["a.png", "b.csv"])
    lines = [line.rstrip() for line in printed(capsys, report, verbose=True) if line.strip()]
    assert lines[1:5] == [
        "  loop   method   residual [nm]",
        " " + 31 * "─",
        "  a      kalman          1234.6",
        "  long   hinf          unstable",
    ]
    assert "residual   1234.6   nm" in lines[-3]
    assert lines[-2:] == ["written: a.png", "written: b.csv"]
    other = {"a": np.array([1.0, np.nan]), 2: (np.int64(3), np.True_, 1 + 2j)}  # not of JSON
    assert json_value(other) == {"a": [1.0, None], "2": [3, True, [1.0, 2.0]]}


@pytest.mark.parametrize("width", [30, 40, 80, 200])
def test_no_number_is_cut_for_a_narrow_terminal(capsys, monkeypatch, width):
    """Columns move below each other before a number loses a digit; words and digests are broken."""
    monkeypatch.setattr("lbt_synth.cli.output._WIDTH", width)
    headings = ("design", "above the limit of the band [%]", "computed by", "residual [nm]")
    numbers = [("1304.501234", "-4.00071e-11"), ("231.599999", "175.071234")]
    digest = "7fca5104ba11fd3491526e67a502252483eee8233e85fe02f227a7f95c5518a3"
    report = Report()
    rows = [(f"integrator {a}", a, f"level sets {digest}", b) for a, b in numbers]
    report.add_table("Distance to the limits", headings, rows)
    lines = printed(capsys, report, verbose=True)
    assert max(map(len, lines)) <= width
    assert "…" not in "".join(lines)
    words = {*" ".join(lines).split()}
    assert {"integrator", "sets", "[%]", "[nm]"}.union(*numbers) <= words
    captions = sum(line.startswith("Distance") for line in lines)
    assert captions == {30: 3, 40: 3, 80: 1, 200: 1}[width]
    assert (digest in words) is (width == 200)


READ_ONLY = {"show", "verify"}  # they write nothing
WITHOUT_INPUTS = {"paper", "init", "explore"}
# Inputs by their names in a directory, and arguments; OUT is where the output goes, under the
# name of the input that it would replace.
CASES = {
    "design": ("config.yaml", "config.yaml --method integrator -o OUT.fits"),
    "export": ("gain.fits", "gain.fits --for c -o other.c", "other.h"),
    "rehearse": ("series.fits", "series.fits gain.fits --for dao -o OUT.pdf"),
    "rehearse law": (
        "config.yaml",
        "series.fits gain.fits --for c --commands config.yaml -o OUT.csv",
    ),
    "plot": ("gain.fits", "nyquist gain.fits -o a.csv -o OUT.png"),
    "simulate": ("gain.fits", "config.yaml gain.fits -o OUT.png"),
    "simulate telemetry": ("gain.fits", "config.yaml gain.fits --frames 50 --telemetry OUT.fits"),
    "telemetry": ("series.fits", "series.fits -o OUT.fits"),
    "auto": ("series.fits", "series.fits -o OUT.fits"),
    "diagnose": ("gain.fits", "series.fits gain.fits -o a.html --pdf OUT.pdf"),
    "identify": ("config.yaml", "series.fits --commands config.yaml -o OUT.yaml"),
    "compare": ("gain.fits", "config.yaml gain.fits -o OUT.csv"),
    "robustness": ("gain.fits", "config.yaml gain.fits -o OUT.csv"),
    "report": ("gain.fits", "config.yaml gain.fits -o a.html --pdf OUT.pdf"),
    "tradeoff": ("config.yaml", "config.yaml -o OUT.csv"),
    "limits": ("gain.fits", "config.yaml gain.fits -o OUT.pdf"),
    "mirror": ("config.yaml", "config.yaml -o OUT.png"),
    "modal": ("config.yaml", "config.yaml -o OUT.csv"),
    "end-to-end": ("gain.fits", "config.yaml gain.fits -o .", "telemetry.fits"),
    "end-to-end tables": ("gain.fits", "config.yaml gain.fits -o . --tables II", "table_ii.csv"),
    "study": ("study.yaml", "study.yaml -o .", "summary.html"),
    "study row": ("config.yaml", "study.yaml -o . --row 3", "row_3.yaml"),
}


@pytest.fixture(scope="module")
def originals(tmp_path_factory, small_designs):
    folder = tmp_path_factory.mktemp("originals")
    shutil.copy(LBT_YAML, folder / "config.yaml")
    (folder / "study.yaml").write_text(
        "version: 1\nconfig: config.yaml\nsamples: 4\nparameters: {loop.delay_frames: 2.5}\n"
        "controllers: {a: {design: integrator, gain: 0.4}, b: {file: gain.fits}}\n"
    )
    lbt.save_gain(folder / "gain.fits", small_designs["slow"])
    two = {"commands": [[0.0, 1.0]], "measurements": [[3.0, 2.0]]}
    series = lbt.files.Telemetry(frame_rate_hz=800, **two)
    lbt.files.save_telemetry(folder / "series.fits", series)
    return folder


@pytest.mark.parametrize("case", CASES)
def test_an_output_that_is_an_input_is_refused(tmp_path, capsys, monkeypatch, originals, case):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(originals, tmp_path, dirs_exist_ok=True)
    source, words, *target = CASES[case]
    (taken,) = target or re.findall(r"OUT\S*", words)
    os.link(source, taken)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    words = f"{case.split()[0]} {words}"
    refuse_commands(capsys, [(words, f"must not replace the input {source}")])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert (tmp_path / taken).samefile(source)


POINT_ENDS = r"\n\n|\n(?:note|warning|written): "  # of what a command says first
SCREEN = {  # words and what a command says of its point, in the unit of the configuration
    "design lbt.yaml --method kalman -o k.fits": r"The Kalman filter leaves 5.12 mas rms",
    "design lbt.yaml --method hinf -o h.fits": r"(\d+) of \1 checks passed",
    "design lbt.yaml --method integrator -o i.fits": r"A sensor gain that is off by 0.78 dB makes",
    "show k.fits": r"35 % above the 3.79 mas of the best linear one",
    "verify h.fits": r"h.fits: verified. (\d+) of \1 checks passed",
    "compare lbt.yaml k.fits h.fits i.fits": r"k has the largest margin",
    "plot sigma k.fits h.fits i.fits -o s.png": r"k, with the largest margin, survives 0.47 frames",
    "plot step k.fits h.fits": r"settling time, to 5 %",
    "limits lbt.yaml k.fits": r"worst residual below \S+ mas rms",
    "robustness lbt.yaml k.fits h.fits": r"h keeps the highest Strehl ratio at worst over",
    "tradeoff lbt.yaml --points 2": r"least norm of any filter lies between 15.6",
    "mirror lbt_slow_mirror.yaml": r"The mirror settles within \S+ ms",
    "modal lbt.yaml --modes 60": r"rms of turbulence in 60 modes, what is left is: integrators",
    "simulate lbt.yaml k.fits i.fits --frames 3300 --cases 2": r"k leaves \S+ mas rms \(Strehl",
    "simulate lbt.yaml k.fits --frames 3300 --telemetry night.fits": r"and 5.12 mas without chance",
    "telemetry night.fits": r"A loop of 2 modes at 800 Hz, for 4.125 s",
    "identify night.fits -o m.yaml --no-figure": r"1 vibration, the strongest of .* at 20.* Hz",
    "auto night.fits -o a.fits --no-figure": r"on unseen data, where what ran left [\d.]+ mas",
    "diagnose night.fits k.fits": r"The record is sound.*; k would leave .* k [\d.]+ [\d.]+",
    "export k.fits --for c -o c.c": r"What c computes differs from the controller by \S+ of",
    "rehearse night.fits k.fits --for c": r"On \d+ frames of night.fits: .* rms \(what ran\)",
    "report lbt.yaml k.fits h.fits -o r.html": r"^k leaves 5.12 mas rms .* written: r.html",
    "study study.yaml -o study": r"note: 64 of 64 samples computed in",
    "study study.yaml -o study --row 3": r"Row 3, computed again, gives what is stored",
    "init --examples -o d": r"Next, lbt-synth design d/lbt.yaml .* makes a controller",
    "init --telescope vlt": r"Next, put in your own numbers; then lbt-synth design vlt.yaml",
    "simulate sensors.yaml sensors.fits --drop m1@1s --frames 1500": r"sensors leaves \S+ nm rms",
}


def verdict_on_screen(text):
    """Return the verdict of at most three sentences above one table, on a screen."""
    lengths, verdict = [len(line) for line in text.splitlines()], re.split(POINT_ENDS, text)[0]
    tables = len(re.findall("(?m)^ ─+$", text))
    fits = len(lengths) <= 25, max(lengths) <= 100, tables <= 1
    assert (fits, verdict.startswith(" ")) == ((True, True, True), False), text
    assert 1 <= len(re.findall(r"\.(?=\s|$)", verdict)) <= 3, verdict
    return " ".join(verdict.split())


def test_a_command_fits_on_a_screen(tmp_path, capsys, monkeypatch, sensors_config, sensors_file):
    """Every command says its point first, a sentence, with wavefronts in ``units`` of the file."""
    monkeypatch.chdir(tmp_path)
    for path in (*(ROOT / "examples").glob("*.yaml"), sensors_config.source, sensors_file):
        text = path.read_bytes()
        if path.name in ("lbt.yaml", "lbt_slow_mirror.yaml"):
            text = f"{with_errors(text.decode(), -1, 1)}\nunits: mas\n".encode()
        Path(path.name).write_bytes(re.sub(rb"(?m)^samples: .*$", b"samples: 64", text))
    for words, point in SCREEN.items():
        text = run_done(capsys, *words.split())
        assert verdict_on_screen(text).endswith("."), words
        assert re.search(point, " ".join(text.split())), (words, text)
        if not re.search(r"modal|study|sensors", words):
            assert re.findall(r".*\bnm\b.*", text) == [], words
    elsewhere = {"explore", "end-to-end", "paper"}  # one runs until it is ended, one needs an extra
    assert {words.split()[0] for words in SCREEN} | elsewhere == set(COMMANDS)
    assert {case.split()[0] for case in CASES} | READ_ONLY | WITHOUT_INPUTS == set(COMMANDS)


MANY = {  # commands with fifteen gain files of long names, what they say, and how many rows
    "compare {} -o c.csv": (r"^(\S+14) leaves 51.0 .* \1 has the largest margin, and", 12),
    "plot nyquist {}": (r"^\S+14, with the largest margin, survives .* \S+_13, with the least", 9),
    "robustness {} --delay-errors -1 0 1 --errors-hz -1 1 3 --sensor-gains 0.5 1 3": (
        r"^\S+_00, \S+_01 and 13 others are unstable at up to \d of 9 pairs of a sensor gain and",
        12,
    ),
    "simulate {} --frames 500 --cases 1": (r"\S+_14 leaves the least, .* \S+ leaves the most", 12),
    "simulate {} --frames 500 --cases 1 --sensor-gain 1.8": (r"^\S+, \S+ and 12 others are u", 12),
}


def test_many_gain_files_fit_on_a_screen(tmp_path, capsys, monkeypatch, gains):
    """The rows that the verdict names are shown, and no row is in two parts."""
    monkeypatch.chdir(tmp_path)
    names = [f"a_long_name_of_a_design_file_{i:02}.fits" for i in range(15)]
    for name in names:
        shutil.copy(gains["kalman" if name == names[-1] else "hinf"], name)
    for words, (point, count) in MANY.items():
        config = [] if words.startswith("plot") else [str(LBT_YAML)]
        text = run_done(capsys, *words.format(" ".join([*config, *names])).split())
        verdict, rows = verdict_on_screen(text), re.findall(r"(?m)^  (a_\S+)", text)
        assert (re.search(point, verdict) is not None, len(rows) >= count) == (True, True), text
        assert not words.startswith(("compare", "plot")) or rows[-1].endswith("file_14"), text


def test_what_is_printed_is_cut_to_a_screen(capsys):
    """Warnings come before notes; rows are from end to end, and of facts the first."""
    report = Report(verdict=["The point.", f"A sentence of {' many words' * 20}."])
    report.add_table("Table", ("row", "value"), [(f"r{i}", i) for i in range(40)])
    report.notes = ["remark", *(f"note: {i}" for i in range(30)), "warning: look"]
    report.note_written("a.png", "b.csv")
    lines = printed(capsys, report)
    assert (len(lines), max(map(len, lines)) <= 100) == (25, True)
    assert lines[0].startswith("The point. A sentence")
    rows = [line.split()[0] for line in lines if re.match(r"  r\d", line)]
    assert (len(rows), rows[0], rows[-1]) == (12, "r0", "r39")
    assert lines.index("warning: look") < lines.index("note: 0")
    assert lines[-2:] == ["... more with --verbose", "written: a.png, b.csv"]
    text = "\n".join(printed(capsys, report, verbose=True))
    assert all(word in text for word in ("remark", "r17", "note: 29"))
    long = f"assumes: the sensor gain lies {'between two limits ' * 40}."
    report.notes += [long, "assumes: the commands are as recorded.", "warning: unstable."]
    lines = printed(capsys, report)
    kept = [line for line in lines if line.endswith(("(--verbose)", "recorded.", "unstable."))]
    assert (len(lines), len(kept)) == (25, 3)  # what an assumption says is never left out
    assert sum("between two limits" in line for line in lines) == 2
    report.tables.clear()
    wide = [f"a heading of column {i}" for i in range(12)]
    report.add_table("Wide", wide, [["1234.5678901"] * 12] * 9)
    cut = printed(capsys, report)
    assert (len(cut), cut[-2]) == (25, "... more with --verbose")
    assert [line for line in cut if line in kept] == kept
    report = Report()
    report.add_table("Facts", ("quantity", "value"), [(f"q{i}", i) for i in range(40)])
    facts = re.findall(r"  (q\d+)", "\n".join(printed(capsys, report)))
    assert facts == [f"q{i}" for i in range(12)]
