"""The command paper: tables, figures and gain files beside those of the paper."""

import csv
import re

import pytest
from support.commands import run

import lbt_synth as lbt
from lbt_synth.cli import paper
from lbt_synth.studies.paper import modal_row, paper_filters, plan_rows


def test_paper(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "a" / "b", "--verbose")
    assert status == 0
    assert "Table III" in text
    assert "fitted" in text
    assert (tmp_path / "a" / "b" / "table_iii.csv").exists()


def test_paper_in_the_unit_of_the_user(tmp_path, capsys):
    status, text, _ = run(capsys, "paper", "-o", tmp_path / "mas", "--unit", "mas", "--verbose")
    assert status == 0
    assert re.search(r"turbulence pole, rms +0\.98860, 59\.38 mas ", text)
    assert re.search(r"80 mas as the rms of a sinusoid +80\.00 mas ", text)
    assert " nm" not in text
    assert "797.0 nm" in (tmp_path / "mas" / "parameters.csv").read_text()  # CSV stays in nm


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(scope="module")
def written(folder):
    """The files of the paper, and the figures of robustness that were drawn for them."""
    drawn = []

    def draw(*arguments):
        drawn.append(lbt.report.figures.robustness_figure(*arguments))
        return drawn[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "robustness_figure", draw)
        rows = [(row, modal_row(row)) for row in plan_rows()]
        return paper._write_paper(folder, rows, paper_filters()), drawn


def test_written_files(folder, written):
    files, _ = written
    assert {p.name for p in files} == {
        "table_ii.csv",
        "table_iii.csv",
        "parameters.csv",
        "robustness.png",
        "robustness.pdf",
        "sigma.png",
        "sigma.pdf",
        "paper_kalman.fits",
        "paper_hinf.fits",
    }
    with (folder / "table_iii.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 30
    assert float(rows[0]["paper_strehl_percent"]) == 22.4
    assert lbt.load_gain(folder / "paper_hinf.fits").recertify().passed


def test_the_papers_points_lie_on_our_curves(written):
    _, drawn = written
    lines = {line.get_label(): line.get_xydata() for line in drawn[0].axes[0].get_lines()}
    assert len(lines) == 4
    for name in ("Kalman", "H∞"):
        ours, theirs = lines[name], sorted(map(tuple, lines[f"{name}, paper"]))
        assert ours[:, 0].tolist() == [error for error, _ in theirs]
        assert max(abs(ours[:, 1] - [strehl for _, strehl in theirs])) < 1.5  # points of percent
