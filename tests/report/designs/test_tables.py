"""The verdict of a report is made of its numbers."""

import re

import numpy as np

import lbt_synth as lbt
from lbt_synth.report.designs.tables import good_range, summary_table, verdict


def test_the_verdict_is_made_of_the_numbers(report):
    words = verdict(report).replace("\u00a0", " ")
    kalman, slow, _ = report.assessments
    assert f"Least residual: kalman, {kalman.residual_nm:.1f} nm rms" in words
    assert f"Strehl ratio {100 * kalman.strehl:.1f} %" in words
    worst = {one.name: 100 * np.min(one.curve.strehl) for one in (kalman, slow)}
    best = max(worst, key=worst.get)
    assert f"are wrong by -3.5 to +3.5 Hz: {best}, {worst[best]:.1f} %." in words
    assert len(re.split(r"(?<=[a-z%]\.) |(?<=them\.) ", words)) <= 3
    table = {row[0]: row[1:] for row in summary_table(report).rows if len(row) > 1}
    assert table["worst Strehl ratio [%]"] == (*(f"{v:.2f}" for v in worst.values()), "-")
    low_hz, high_hz = good_range(kalman)
    strehls, errors = kalman.curve.strehl[0, 0], kalman.curve.errors_hz
    inside = (errors >= low_hz) & (errors <= high_hz)
    assert np.all(strehls[inside] >= 0.9 * strehls.max())
    outside = np.flatnonzero(np.diff(inside.astype(int)))
    for edge in outside:
        assert min(strehls[edge], strehls[edge + 1]) < 0.9 * strehls.max()
    inside = table["within 10 % of its best Strehl ratio [Hz]"]
    assert inside[0] == f"{low_hz:+.4g} to {high_hz:+.4g}"
    assert good_range(report.assessments[2]) is None
    assert "ertificates that do NOT hold: wild." in words


def test_equal_designs_share_the_lead(few, designs):
    kalman = designs["kalman"]
    pair = {"one": kalman, "two": kalman}
    words = verdict(lbt.report.design_report(few, pair)).replace("\u00a0", " ")
    assert "Least residual: one and two, " in words
    assert "Hz: one and two, " in words
    three = verdict(lbt.report.design_report(few, {"slow": designs["slow"], **pair}))
    assert "Least residual: one and two, " in three
    assert "Hz: one and two, " in three or "Hz: slow, " in three
