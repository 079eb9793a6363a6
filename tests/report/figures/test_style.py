"""Figures as files."""

import pytest

import lbt_synth as lbt
from lbt_synth.report.figures.style import save_figure


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_figures_are_files(tmp_path, designs, ending):
    path = save_figure(lbt.report.figures.sigma_figure(designs), tmp_path / f"f.{ending}")
    magic = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[ending]
    assert path.read_bytes().startswith(magic)
    assert path.stat().st_size < 400_000


def test_other_endings_are_refused(tmp_path, designs):
    with pytest.raises(lbt.errors.OutputError, match=r"must end in .png, .pdf, .svg; got 'f.gif'"):
        save_figure(lbt.report.figures.sigma_figure(designs), tmp_path / "f.gif")
