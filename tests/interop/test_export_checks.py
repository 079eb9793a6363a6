"""What no export accepts."""

import json
from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.interop import export_c, export_dao, export_mat

pytestmark = pytest.mark.usefixtures("short_rehearsal")
EXPORTS = {"k.c": export_c, "k.mat": export_mat, "k.npy": export_dao}


@pytest.mark.parametrize("file", EXPORTS)
def test_what_no_format_takes(tmp_path, designs, file):
    export, target = EXPORTS[file], tmp_path / file
    with pytest.raises(lbt.errors.ProblemError, match="expected a Design; got int"):
        export(target, 3)
    failed = lbt.design.Check(name="rms", value=2.0, limit=1.0, computed_by="guess")
    with pytest.raises(lbt.errors.CertificateError, match="this one failed: rms") as caught:
        export(
            target,
            replace(
                designs["integrator"],
                certificate=lbt.design.Certificate(
                    checks=(failed,), gamma=np.nan, rms_per_output=np.zeros(0)
                ),
            ),
        )
    assert caught.value.failed == ("rms",)
    for digest in ("abc", "AB" * 32, 3, "ab" * 32 + "\n"):
        with pytest.raises(lbt.errors.ProblemError, match="64 hexadecimal digits"):
            export(target, designs["integrator"], gain_digest=digest)
    with pytest.raises(lbt.errors.OutputError, match="must end in"):
        export(tmp_path / "k.txt", designs["integrator"])
    with pytest.raises(lbt.errors.OutputError, match="cannot write"):
        export(tmp_path / "nowhere" / file, designs["integrator"])
    assert not list(tmp_path.iterdir())


def test_exports_to_two_targets_keep_their_certificates(tmp_path, designs):
    export_c(tmp_path / "k.c", designs["integrator"])
    export_dao(tmp_path / "k.npy", designs["integrator"])
    found = {path.name: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert {name: read["target"] for name, read in found.items()} == {
        "k.c.certificate.json": "c",
        "k.npy.certificate.json": "dao",
    }
