"""Numbers, lists and durations in sentences."""

from lbt_synth.storage.words import count_text, duration_text, listing_text


def test_things_are_counted():
    assert [count_text(n, "state") for n in (0, 1, 2)] == ["0 states", "1 state", "2 states"]
    assert [count_text(n, "axis", "axes") for n in (1, 2)] == ["1 axis", "2 axes"]


def test_things_are_listed():
    assert listing_text([]) == ""
    assert listing_text(["a", "b", "c"]) == "a, b and c"


def test_durations_have_the_unit_that_suits_them():
    seconds = (12.34, 192.0, 7 * 3600.0, 123 * 3600.0)
    assert [duration_text(each) for each in seconds] == ["12.3 s", "3.2 min", "7 h", "5.12 days"]
