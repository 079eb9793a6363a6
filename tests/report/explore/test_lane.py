"""A thread that works on what was asked for last."""

from threading import Event

from lbt_synth.report.explore.lane import Lane


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
