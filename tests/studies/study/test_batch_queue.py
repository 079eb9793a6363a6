"""Sizes of batches."""

from __future__ import annotations

from lbt_synth.studies.study.batch_queue import BatchQueue


def sizes_of(batches, seconds):
    out = []
    while batches.left:
        start, stop = batches.take()
        out.append((start, stop))
        batches.learn(stop - start, seconds(stop - start))
    assert all(start < stop for start, stop in out)
    return out


def test_batches_follow_what_is_measured():
    given = sizes_of(BatchQueue([(0, 10), (20, 1_000_000)], 2), lambda rows: 1e-4 * rows)
    assert given[:2] == [(0, 4), (4, 10)]  # to the end of a range
    assert [start for start, _ in given[3:]] == [stop for _, stop in given[2:-1]]
    assert given[2][0] == 20
    assert given[-1][1] == 1_000_000
    sizes = [stop - start for start, stop in given]
    assert sizes[2:7] == [24, 96, 384, 1536, 6144]
    assert sizes[7:40] == [15_000] * 33  # a second and a half
    assert sizes[-1] <= 1000  # none waits long for the last
    assert len(sizes) < 100


def test_batches_are_longer_where_each_costs_something():
    given = sizes_of(BatchQueue([(0, 1_000_000)], 2), lambda rows: 0.5 + 1e-4 * rows)
    sizes = [stop - start for start, stop in given]
    assert max(sizes) == 65_536
    assert len(sizes) < 45  # twenty seconds of a hundred, and shares at the end


def test_the_first_batch_may_be_slow():
    seconds = iter([30.0])
    given = sizes_of(BatchQueue([(0, 10_000)], 2), lambda rows: next(seconds, 1e-3 * rows))
    assert max(stop - start for start, stop in given) == 1500
    assert len(given) < 30


def test_slow_rows_come_one_by_one():
    given = sizes_of(BatchQueue([(0, 40)], 2), lambda rows: 10.0 * rows)
    assert [stop - start for start, stop in given] == [4] + [1] * 36
    long = BatchQueue([(0, 10**8)], 2)
    for rows in (100, 1000):
        long.learn(rows, 1e-3 * rows)
    assert long.take() == (0, 4000)  # at most four times what was measured
    long.learn(65_536, 65.536)
    assert long.take()[1] - 4000 > 24_000  # a file every 25 s rather than a million files
