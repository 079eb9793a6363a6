"""The page of a diagnosis: it has what is known, and says loudly what is wrong."""

import hashlib
import re

import pytest
from support.diagnoses import line_diagnosis, short_record
from support.pages import Reader

import lbt_synth as lbt
from lbt_synth.cli.records import diagnosis_page
from lbt_synth.report.page.html import write_page


@pytest.fixture(scope="module")
def page():
    return diagnosis_page(line_diagnosis())


def test_sections_and_charts(page):
    assert list(page.sections) == [
        "Verdict",
        "Record",
        "Loop that ran",
        "Disturbance",
        "Files and versions",
    ]
    (spectra,) = page.charts
    assert (spectra.key, len(spectra.figure.axes)) == ("identification", 3)
    (table,) = (t for t in page.blocks if getattr(t, "caption", "").startswith("Residual on"))
    names = [row.name for row in line_diagnosis().residuals]
    assert [row[0] for row in table.rows] == names


def test_files(tmp_path):
    source = tmp_path / "night.npz"
    source.write_bytes(b"what was recorded")
    (path,) = write_page(diagnosis_page(line_diagnosis(), [source]), tmp_path / "page.html")
    headings = re.findall(r"<th scope=.col.[^>]*>([^<]*)<", path.read_text())
    assert "± [nm]" in headings
    assert not [heading for heading in headings if "+-" in heading]
    text = path.read_text(encoding="utf-8")
    reader = Reader(text)
    assert reader.texts["h1"] == ["Diagnosis of night.npz"]
    assert hashlib.sha256(b"what was recorded").hexdigest() in text
    (notice,) = (a for a in reader.named("p") if "good" in (a.get("class") or ""))
    assert notice["class"] == "notice good"


def test_what_is_wrong_comes_first_and_loudly(tmp_path):
    found = lbt.identification.diagnose(short_record(-1.0))
    page = diagnosis_page(found)
    first = page.blocks[0]
    assert (first.tone, first.text) == (
        "bad",
        "The commands are not those that the mirror followed: they have the opposite sign.",
    )
    assert page.charts == []
    assert list(page.sections)[:3] == ["Verdict", "Record", "Loop that ran"]
