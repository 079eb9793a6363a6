"""A thread that works on what was asked for last."""

from threading import Event

from lbt_synth.report.explore.lane import Lane
from lbt_synth.storage.display_unit import DisplayUnit, nm_text, own_display_unit, show_in


def test_newer_work_replaces_what_waits():
    lane, began, go_on, ended = Lane(), Event(), Event(), Event()
    done = []

    def first():
        began.set()
        assert go_on.wait(10)
        done.append((1, lane.is_waiting))

    lane.submit(first)
    assert began.wait(10)
    assert not lane.is_waiting
    lane.submit(lambda: done.append((2, None)))
    lane.submit(lambda: (done.append((3, lane.is_waiting)), ended.set()))
    go_on.set()
    assert ended.wait(10)
    assert done == [(1, True), (3, False)]
    lane.close()


def test_a_closed_lane_drops_what_waits():
    lane, began, go_on = Lane(), Event(), Event()
    lane.submit(lambda: (began.set(), go_on.wait(10)))
    assert began.wait(10)
    lane.submit(lambda: began.clear())
    lane.close()
    go_on.set()
    lane._thread.join(10)
    assert not lane._thread.is_alive()
    assert began.is_set()


def test_work_is_shown_in_the_unit_of_the_page():
    shown, ended = [], Event()
    with own_display_unit():
        show_in(DisplayUnit(name="mas", nm=10.0))
        lane = Lane()
    lane.submit(lambda: (shown.append(nm_text(20.0)), ended.set()))
    assert ended.wait(10)
    assert shown == ["2 mas"]
    lane.close()
