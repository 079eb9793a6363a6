"""The page of a league."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from support.league import GAIN, short_record

import lbt_synth as lbt
from lbt_synth.errors import OutputError
from lbt_synth.report.league.page import league_page, standing_notes, verdict_text
from lbt_synth.report.page.blocks import Notice
from lbt_synth.storage.tables import Table


@pytest.fixture(scope="module")
def league(tmp_path_factory):
    records = {"night": short_record(), "open": replace(short_record(closed=False), delay_frames=2)}
    names = ("ran", "best-integrator", "least-squares-32", "kalman")
    found = lbt.studies.run_league(
        records, tmp_path_factory.mktemp("league"), entries=names, splits=2,
        options={"night": {"sensor_gain": GAIN, "most_lines": 2}, "open": {"most_lines": 2}},
    )  # fmt: skip
    return found, records


def test_the_page_has_the_standings_and_each_record(league):
    found, records = league
    page = league_page(found, records)
    assert page.subtitle.startswith("4 entries on 2 records, 2 splits each. Made ")
    tables = {
        block.caption: block
        for section in page.sections
        for block in section.blocks
        if isinstance(block, Table)
    }
    assert list(tables) == ["Standings", "Records", "night", "open", "Made with"]
    assert [row[1] for row in tables["Standings"].rows] == [row.entry for row in found.standings]
    assert [row[0] for row in tables["Records"].rows] == ["night", "open"]
    assert len(tables["night"].rows) == 4
    assert len(tables["open"].rows) == 3
    assert all(table.rows[0][3] == "0.00" for name, table in tables.items() if name in records)


def test_what_did_not_run_is_said(league):
    found, records = league
    (note,) = standing_notes(found)
    assert note == "what ran: on 1 of 2 records: nothing ran: the record is of an open loop"
    failed = replace(found, failures={"brief": "too short"})
    notices = [
        block.text
        for section in league_page(failed, records).sections
        for block in section.blocks
        if isinstance(block, Notice)
    ]
    assert notices[0] == "brief is not in the table: too short"
    assert note in notices


def test_the_verdict_names_what_cannot_be_distinguished(league):
    rows = league[0].standings
    near = replace(rows[1], above_best=0.01, above_best_error=0.006)
    far = replace(rows[2], above_best=0.02, above_best_error=0.006)
    assert verdict_text([rows[0]]) == "First: Kalman filter."
    assert verdict_text([rows[0], near, far]) == (
        f"First: Kalman filter. Second: {near.entry}, 1.00 +- 0.60 % above the best of each record."
        f" Within two standard errors of the best: {near.entry}."
    )


def test_files(league, tmp_path):
    found, records = league
    source = tmp_path / "night.fits"
    source.write_bytes(b"x")
    (page,) = lbt.report.write_league_page(found, records, tmp_path / "a.html", sources=[source])
    text = page.read_text()
    assert "± [nm]" in text
    assert "+-" not in re.sub(r"(?s)<script.*?</script>", "", text)
    assert "best integrator in hindsight" in text
    assert "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881" in text  # of "x"
    with pytest.raises(OutputError, match=r"must end in \.html"):
        lbt.report.write_league_page(found, records, tmp_path / "a.txt")
