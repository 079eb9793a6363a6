"""The commands report and explore: their files, their output, and their errors."""

from __future__ import annotations

import hashlib
import json
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import pytest
from support.commands import hear_interruptions, run
from support.design_reports import SMALL, three_designs
from support.pages import Reader
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("report")
    (place / "small.yaml").write_text(SMALL)
    return place


@pytest.fixture(scope="module")
def config(folder):
    return lbt.load_config(folder / "small.yaml")


@pytest.fixture(scope="module")
def designs(config):
    return three_designs(config)


@pytest.fixture(scope="module")
def report(config, designs):
    return lbt.report.design_report(config, designs)


def test_command(folder, designs, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    for name in ("kalman", "slow"):
        lbt.save_gain(f"{name}.fits", designs[name])
    command = ("report", "small.yaml", "kalman.fits", "slow.fits")
    status, out, error = run(capsys, *command, "-o", "r.html", "--json")
    assert (status, error) == (0, "")
    data = json.loads(out)
    assert data["files"] == ["r.html"]
    assert list(data["designs"]) == ["kalman", "slow"]
    kalman = data["designs"]["kalman"]
    loop = lbt.close_loop(lbt.load_config("small.yaml").hardware, designs["kalman"].controller)
    budget = lbt.residual_budget(loop, lbt.load_config("small.yaml").truth)
    assert kalman["residual_nm"] == pytest.approx(budget.rms_nm)
    assert kalman["certified"] is True
    assert (
        data["sha256"]["kalman.fits"]
        == hashlib.sha256(Path("kalman.fits").read_bytes()).hexdigest()
    )
    assert data["made"] == "2023-11-14 22:13:20 UTC"
    first = Path("r.html").read_bytes()
    status, out, _ = run(capsys, *command, "-o", "r.html")
    assert status == 0
    assert "Least residual: kalman" in out
    assert "written: r.html" in out
    assert Path("r.html").read_bytes() == first


def test_hostile_files_are_quoted(folder, designs, tmp_path, capsys):
    name = "<script>alert('x')<" + "_k.fits"
    lbt.save_gain(tmp_path / name, designs["slow"])
    yaml = tmp_path / "a&b.yaml"
    yaml.write_text("# </code></pre><script>alert(2)</script>\n" + SMALL)
    out_file = tmp_path / "r.html"
    status, _, error = run(
        capsys,
        "report",
        str(yaml),
        str(tmp_path / name),
        "-o",
        str(out_file),
        "--title",
        "<i>T</i>",
    )
    assert (status, error) == (0, "")
    text = out_file.read_text()
    reader = Reader(text)
    assert not reader.named("script")
    assert not reader.named("i")
    assert reader.texts["title"] == ["<i>T</i>"]
    assert reader.texts["code"][0].startswith("# </code></pre><script>alert(2)</script>")
    assert "<script>alert('x')<_k" in reader.texts["th"]


def test_pages_name_no_directories(folder, designs, tmp_path, capsys):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        lbt.save_gain(tmp_path / place / "k.fits", designs["slow"])
    files = [str(tmp_path / place / "k.fits") for place in ("a", "b")]
    status, out, _ = run(
        capsys, "report", str(folder / "small.yaml"), *files, "-o", str(tmp_path / "r.html")
    )
    assert status == 0
    assert "Least residual: a/k.fits and b/k.fits, " in out
    text = (tmp_path / "r.html").read_text()
    assert "a/k.fits" in text
    assert str(tmp_path) not in text


@pytest.mark.parametrize("name", ["red\x1b[31m", "two\nlines", "bad\udcff", "turned\u202e"])
def test_names_that_no_page_can_show_are_escaped(folder, designs, tmp_path, capsys, name):
    lbt.save_gain(tmp_path / "k.fits", designs["slow"])
    odd = (tmp_path / "k.fits").rename(tmp_path / f"{name}.fits")
    page = tmp_path / "r.html"
    status, out, error = run(capsys, "report", str(folder / "small.yaml"), str(odd), "-o", page)
    assert (status, error) == (0, "")
    escaped = name.encode("unicode_escape").decode()
    assert f"Least residual: {escaped}, " in out
    assert "<h1>Controllers for small.yaml</h1>" in page.read_text()


@pytest.fixture(scope="module")
def gains(folder, designs, config):
    lbt.save_gain(folder / "ok.fits", designs["slow"])
    lbt.save_gain(folder / "one_axis.fits", lbt.kalman(lbt_axis_plant(modes=1)))
    other = replace(config.hardware, frame_rate_hz=1000.0)
    lbt.save_gain(folder / "fast.fits", lbt.integrator(other, gain=0.4))
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    lbt.save_gain(folder / "bare.fits", lbt.kalman(walk))
    drift = SMALL.replace(
        "{kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}",
        "{kind: drift, axis: tip, frequency_hz: 20.0, end_hz: 21.0, duration_s: 5.0, rms_mas: 80.0}",
    )
    (folder / "drift.yaml").write_text(drift)
    return folder


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ("small.yaml", "one_axis.fits", "-o", "x.html"),
            "one_axis must be for the configuration's 2",
        ),
        (("small.yaml", "fast.fits", "-o", "x.html"), "800 Hz; got a design for 1000 Hz"),
        (("small.yaml", "bare.fits", "-o", "x.html"), "bare estimation problem"),
        (("small.yaml", "ok.fits", "-o", "x.pdf"), "a page must end in .html; got 'x.pdf'"),
        (("small.yaml", "ok.fits", "-o", "x.html", "--pdf", "x.ps"), "a page must end in .pdf"),
        (("small.yaml", "ok.fits", "-o", "x.html", "--title", " "), "--title must hold"),
        (("drift.yaml", "ok.fits", "-o", "x.html"), "a truth that is stationary"),
    ],
)
def test_bad_input_ends_in_one_line(gains, capsys, monkeypatch, arguments, text):
    monkeypatch.chdir(gains)
    status, out, error = run(capsys, "report", *arguments)
    assert (status, out) == (2, "")
    assert text in error
    assert error.count("\n") == 1
    assert not Path("x.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--port", "70000"), "--port must be at most 65535"),
        (("--origin", "http://a:8"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("--origin", "a\x07b:8"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("--origin", "a:123456"), "--origin must be HOST:PORT, as localhost:8080; got"),
        (("-o", "nowhere"), "no directory nowhere"),
        (("nothing.fits",), "nothing.fits"),
    ],
)
def test_wrong_words_are_refused(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, "explore", LBT_YAML, *words)
    assert (status, out) == (2, "")
    assert message in error
    assert error.count("\n") == 1


def test_a_design_for_another_loop_is_refused(capsys, tmp_path):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3)
    lbt.save_gain(tmp_path / "slow.fits", design)
    status, _, error = run(capsys, "explore", LBT_YAML, tmp_path / "slow.fits")
    assert status == 2
    assert "slow must run at the configuration's 800 Hz" in error


@pytest.mark.parametrize(
    ("host", "message"),
    [
        ("localhost", "--port {port}: Address already in use"),
        ("no.such.host.invalid", "cannot serve at --host"),
        (64 * "a", "cannot serve at --host"),
    ],
)
def test_a_place_that_is_not_free_is_said(capsys, host, message):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        status, out, error = run(capsys, "explore", LBT_YAML, "--host", host, "--port", port)
    assert (status, out) == (2, "")
    assert message.format(port=port) in error
    assert error.count("\n") == 1


def test_it_serves_until_it_is_interrupted(tmp_path):
    words = ["explore", str(LBT_YAML), "--port", "0", "-o", str(tmp_path), "--json"]
    command = [sys.executable, "-m", "lbt_synth.cli.main", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, preexec_fn=hear_interruptions, **pipes) as process:
        try:
            url = process.stderr.readline().split()[1]
            with urlopen(url) as page:
                text = page.read().decode()
        finally:
            process.send_signal(signal.SIGINT)
        try:
            out, error = process.communicate(timeout=20)
        finally:
            process.kill()  # else the test would wait for ever
    assert "<title>Explore lbt.yaml</title>" in text
    assert (process.returncode, error) == (0, "")
    assert json.loads(out) == {"url": url, "files": []}
