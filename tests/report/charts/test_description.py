"""Colours, dashes and markers of curves."""

from lbt_synth.report.charts.description import colour, dashes, marker_name


def test_different_looks_differ():
    looks = [(colour(i), dashes(i)) for i in range(36)]
    assert len(set(looks)) == 36
    marks = {(colour(i), marker_name("own", i)) for i in range(36)}
    assert len(marks) == 36
    assert colour(None) not in [look[0] for look in looks]
    assert marker_name("cross", 3) == "cross"
