"""The command export."""

import hashlib
import json
import re

import numpy as np
import pytest
from scipy.io import loadmat
from support.commands import run
from support.compiled import Compiled
from support.exports import lbt_config, lbt_designs, with_controller

import lbt_synth as lbt


@pytest.fixture
def loaded():
    return lbt_config()


@pytest.fixture
def designs():
    return lbt_designs()


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gains")
    names = ("kalman", "hinf", "integrator", "prior")
    return {name: lbt.save_gain(folder / f"{name}.fits", lbt_designs()[name]) for name in names}


def test_export_c_at_the_terminal(tmp_path, capsys, designs, gains):
    out = tmp_path / "ctl.c"
    sha256 = hashlib.sha256(gains["kalman"].read_bytes()).hexdigest()  # as `sha256sum` prints it
    status, text, error = run(
        capsys, "export", gains["kalman"], "--for", "c", "-o", out, "--precision", "single"
    )
    assert (status, error) == (0, "")
    assert f"written: {out}" in text
    assert f"written: {out.with_suffix('.h')}" in text
    assert sha256 in out.read_text()
    certificate = json.loads((tmp_path / "ctl.c.certificate.json").read_text())
    assert certificate["gain_sha256"] == sha256
    ours = designs["kalman"].controller.start()
    assert np.allclose(Compiled(out, single=True).step([1, 2]), ours.step([1, 2]), rtol=1e-6)
    status, text, _ = run(
        capsys, "export", gains["kalman"], "--for", "c", "-o", out, "--name", "tip", "--json"
    )
    data = json.loads(text)
    assert status == 0
    endings = (".c", ".h", ".c.certificate.json")
    assert data["files"] == [str(out.with_suffix(ending)) for ending in endings]
    assert data["frame_cost"]["multiplications"] == 30
    assert data["gain_digest"] == sha256
    Compiled(out, name="tip")


def test_export_mat_and_dao_at_the_terminal(tmp_path, capsys, designs, gains):
    out = tmp_path / "k.mat"
    assert run(capsys, "export", gains["hinf"], "--for", "matlab", "-o", out)[0] == 0
    assert loadmat(out, simplify_cells=True)["new_state"]["A"].shape == (10, 10)
    arguments = ("export", gains["kalman"], "--for", "dao", "-o", tmp_path / "k.fits")
    status, text, _ = run(capsys, *arguments)
    assert status == 0
    assert "difference from the controller" in text
    assert "note:" not in text


def test_c_that_single_precision_breaks_gets_a_note(tmp_path, capsys, monkeypatch):
    """An integrator beside large states that the command subtracts again."""
    slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.4)
    large = lbt.Controller(
        A=[[1, 0, 0], [0, 0.3, 0], [0, 0, 0.3]],
        B=[[0.4], [1e5], [1e5]],
        C=[[1, 1, -1]],
        D=[[0]],
        dt_s=1 / 800,
    )
    gain = lbt.save_gain(tmp_path / "g.fits", slow)
    odd = with_controller(slow, large)
    monkeypatch.setattr("lbt_synth.cli.export.load_gain", lambda path: odd)
    arguments = ("export", gain, "--for", "c", "-o", tmp_path / "k.c")
    status, text, _ = run(capsys, *arguments, "--precision", "single")
    assert status == 0
    assert re.search(r"note: in single precision commands are off by [\d.]+ of the largest", text)
    assert "note:" not in run(capsys, *arguments)[1]


def test_export_pyrtc_at_the_terminal(tmp_path, capsys, gains):
    arguments = ("export", gains["kalman"], "--for", "pyrtc", "-o", f"{tmp_path}/k/")
    for _ in range(2):  # into a new folder, and over its files
        status, text, _ = run(capsys, *arguments)
        assert status == 0
        assert text.count("written: ") == 4
    found = json.loads(run(capsys, *arguments, "--json")[1])
    assert {check["passed"] for check in found["checks"]} == {True}


BAD = [
    (("KALMAN", "--for", "matlab", "-o", "k.mat", "--name", "x"), 2, "--name goes with --for c"),
    (
        ("KALMAN", "--for", "matlab", "-o", "k.mat", "--precision", "single"),
        2,
        "--precision goes with --for c",
    ),
    (("KALMAN", "--for", "dao", "-o", "k.fits", "--form", "plain"), 2, "--form goes with --for c"),
    (("KALMAN", "--for", "c", "-o", "k.c", "--precision", "half"), 2, "invalid choice"),
    (("KALMAN", "--for", "c", "-o", "k.c", "--name", "2x"), 2, "prefix of the C names"),
    (("KALMAN", "--for", "c", "-o", "kal man.c"), 2, "must end in .c"),
    (("KALMAN", "--for", "c", "-o", "k.mat"), 2, "must end in .c"),
    (("KALMAN", "--for", "matlab", "-o", "k.c"), 2, "must end in .mat"),
    (("KALMAN", "--for", "cacao", "-o", "k.mat"), 2, "must end in .fits"),
    (("KALMAN", "--for", "cacao", "-o", "KALMAN"), 2, "must not replace the input"),
    (("KALMAN", "--for", "c", "-o", "none/k.c"), 2, "no directory none"),
    (("KALMAN", "--for", "pyrtc", "-o", "none/k"), 2, "no directory none"),
    (("KALMAN", "--for", "pyrtc", "-o", "DAMAGED.fits"), 2, "cannot make the directory"),
    (("KALMAN", "--for", "pyrtc", "-o", "k", "--order", "3"), 2, "--order goes with --for dao"),
    (("KALMAN", "--for", "pdf", "-o", "k.pdf"), 2, "invalid choice"),
    (("KALMAN", "-o", "k.c"), 2, "required"),
    (("none.fits", "--for", "c", "-o", "k.c"), 2, "cannot read none.fits"),
    (("DAMAGED.fits", "--for", "c", "-o", "k.c"), 2, "damaged"),
    (
        ("PRIOR", "--for", "dao", "--order", "40", "-o", "k.npy"),
        1,
        "must keep what its design promises",
    ),
]


@pytest.mark.parametrize(("arguments", "expected", "text"), BAD)
def test_bad_input(tmp_path, capsys, monkeypatch, gains, arguments, expected, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DAMAGED.fits").write_bytes(gains["kalman"].read_bytes()[:4000])
    before = gains["kalman"].read_bytes()
    files = sorted(tmp_path.iterdir())
    names = {"KALMAN": gains["kalman"], "PRIOR": gains["prior"]}
    status, out, error = run(capsys, "export", *(names.get(a, a) for a in arguments))
    assert (status, out) == (expected, "")
    assert text in error
    assert "Traceback" not in error
    assert sorted(tmp_path.iterdir()) == files
    assert gains["kalman"].read_bytes() == before
