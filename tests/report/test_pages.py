"""The pages of a study and of a diagnosis: what they say, and what they must not depend on."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.diagnoses import line_diagnosis, short_record
from support.pages import Reader
from support.plants import ROOT
from support.study_pages import CONTROLLERS, night, page_of, results

import lbt_synth as lbt
from lbt_synth.report.page.html import Chart, Notice, page_html, write_page
from lbt_synth.report.pages import binned_map, cumulative_points, diagnosis_page
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies.study.run import evaluate_samples
from lbt_synth.studies.study.statistics import study_statistics


@pytest.fixture(scope="module")
def page():
    return page_of(results())


def table(page, start):
    return next(b for b in page.blocks if isinstance(b, Table) and b.caption.startswith(start))


def replay_command(page):
    """Return the listing of commands that replay the worst samples."""
    listings = (block for block in page.blocks if isinstance(block, tuple))
    return next(listing for caption, listing in listings if "replay" in caption)


def without_charts(page):
    """The same page without its drawings, which are slow to make."""
    sections = {
        title: [block for block in blocks if not isinstance(block, Chart)]
        for title, blocks in page.sections.items()
    }
    return replace(page, sections=sections)


def cell_text(cell):
    return cell.text if isinstance(cell, Cell) else cell


def test_what_is_wrong_is_said_first(page):
    failed, unstable, words = page.blocks[:3]
    percent = np.sum(results()["sharp.stable"] == 0) / 3
    assert unstable.text == f"sharp is unstable in {percent:.2f} % of the samples."
    assert "frail 6" in failed.text
    assert (failed.tone, unstable.tone) == ("bad", "bad")
    steady = results()["steady.strehl"]
    assert f"Strehl ratios: highest mean, steady {100 * steady.mean():.1f} %" in words
    low = 100 * np.percentile(steady, 5)
    assert f"highest 5th percentile, steady {low:.1f} %. That of steady depends most on" in words
    columns = {name: values[:100] for name, values in results().items()}
    first = page_of(columns).blocks[0]
    assert (first.tone, "100 of 300 samples" in first.text) == ("bad", True)


def test_failures_are_listed_and_counted(page):
    failures = table(page, "Evaluations that failed")
    assert len(failures.rows) == 10
    assert failures.caption.endswith("the first 10, and 5 more")
    html = page_html(without_charts(page)).decode()
    assert "&lt;b&gt;no&lt;/b&gt; design in row 20" in html
    assert "<b>no</b>" not in html


def test_worst_rows_come_with_the_command_that_replays_them(page):
    rows = table(page, "Worst samples of sharp").rows
    assert all(cell_text(row[1]) == "unstable" for row in rows)
    command = f"lbt-synth study night.yaml -o out --row {cell_text(rows[0][0])}"
    assert replay_command(page).splitlines()[1] == command
    other = page_of(results(), study=replace(night(), source=Path("my {b}.yaml")))
    assert "lbt-synth study 'my {b}.yaml' -o out --row " in replay_command(other)


@pytest.mark.parametrize("n", [1, 21])
def test_few_samples_make_a_page_all_the_same(n):
    columns = {name: values[:n] for name, values in results().items()}
    assert b"nan" not in page_html(page_of(columns))


def test_nothing_evaluated_makes_a_page_without_figures():
    columns = results(30)
    for name in columns:
        if "." in name and name.split(".")[0] in CONTROLLERS:
            columns[name] = np.full(30, np.nan)
    page = page_of(columns)
    assert page.sections["Summary"][-3] == "No controller was evaluated on any sample."
    assert page.charts == []


@pytest.fixture(scope="module")
def study():
    return lbt.studies.load_study(ROOT / "examples" / "study.yaml")


def test_a_page_from_a_study_file(study, tmp_path):
    values = study.values(0, 3)
    columns = dict(zip(study.parameter_names, values.T, strict=True))
    columns |= evaluate_samples(study, values, 0)[0] | {"row": np.arange(3)}
    statistics = study_statistics(columns, study.parameter_names, list(study.controllers))
    page = lbt.report.study_page(study, columns, statistics, folder=tmp_path / "a folder")
    html = page_html(without_charts(page)).decode()
    for words in (
        "3 of 4096 samples",
        "normal, 20 with deviation 0.5, from 18, to 22",
        "hinf (gamma_ratio 1.2) for the configuration",
        study.digest,
        "samples: 4096",
        "diameter_m: 8.22",
        "a folder&#39; --row 0",
    ):
        assert words in html, words


def test_each_design_says_which_errors_it_survives(study):
    fast = lbt.integrator(study.config.hardware, gain=0.9)  # unstable above 1
    names = (*study.controllers, "fast")
    columns = {f"{name}.{what}": np.ones(2) for name in names for what in ("strehl", "stable")}
    columns |= {f"{name}.residual_nm": np.ones(2) for name in names} | {"fixed": np.ones(2)}
    designs = {**study.controllers, "fast": fast}
    page = page_of(columns, names, ("fixed",), replace(study, controllers=designs))
    blocks = page.sections["Summary"]
    for name, design in designs.items():
        margins = lbt.loop_margins(lbt.close_loop(design.hardware, design))
        assert f"{name} {margins.survival}" in blocks
        warned = [block.text for block in blocks if getattr(block, "text", "").startswith(name)]
        assert warned == [f"{name}: {words}" for words in margins.fragilities]
    assert "fast: a sensor gain that is off by 0.92 dB makes this loop unstable." in warned


def test_the_size_does_not_grow_with_the_samples():
    small, large = (len(page_html(page_of(results(n)))) for n in (4000, 20_000))
    assert small < large < 1.4 * small
    assert large < 1.5e6


@pytest.mark.parametrize("n", [1, 400, 401, 50_000])
def test_points_of_a_distribution_lie_on_it(n):
    values = np.round(np.random.default_rng(n).normal(size=n), 2)
    level, part = cumulative_points(values)
    assert len(level) <= 500
    assert np.all(np.diff(level) > 0)
    np.testing.assert_allclose(part, [np.mean(values <= bound) for bound in level])
    assert (level[0], part[-1]) == (values.min(), 1)


def test_a_map_has_the_mean_of_each_cell():
    rng = np.random.default_rng(1)
    x, y = rng.random(4000), rng.random(4000)
    columns, rows, mean = binned_map(x, y, x * y)
    assert mean.shape == (rows.size, columns.size) == (22, 22)
    np.testing.assert_allclose(mean, np.outer(rows, columns), atol=0.02)
    sparse = binned_map(np.arange(9.0), np.arange(9.0), np.arange(9.0))[2]
    assert np.isnan(sparse).any()  # a cell without samples


def test_the_page_of_a_diagnosis(tmp_path):
    source = tmp_path / "night.npz"
    source.write_bytes(b"what was recorded")
    page = diagnosis_page(line_diagnosis(), [source])
    (spectra,) = page.charts
    assert (spectra.key, len(spectra.figure.axes)) == ("identification", 3)
    names = [row.name for row in line_diagnosis().residuals]
    assert [row[0] for row in table(page, "Residual on").rows] == names
    (path,) = write_page(page, tmp_path / "page.html")
    reader = Reader(path.read_text(encoding="utf-8"))
    assert "± [nm]" in reader.texts["th"]
    assert reader.texts["h1"] == ["Diagnosis of night.npz"]
    assert hashlib.sha256(b"what was recorded").hexdigest() in reader.texts["td"]
    notices = [a["class"] for a in reader.named("p") if "notice" in (a.get("class") or "")]
    assert "notice good" in notices
    assert "notice bad" not in notices


def test_a_diagnosis_of_wrong_commands_is_loud():
    page = diagnosis_page(lbt.identification.diagnose(short_record(-1.0)))
    assert page.blocks[0] == Notice(
        text="The commands are not those that the mirror followed: they have the opposite sign.",
        tone="bad",
    )
    assert page.charts == []
