"""Numbers, lists and durations in sentences."""

from lbt_synth.storage.words import count_text, duration_text, listing_text, rank_names


def test_numbers_lists_and_durations_are_words():
    assert [count_text(n, "state") for n in (0, 1, 2)] == ["0 states", "1 state", "2 states"]
    assert count_text(2, "axis", "axes") == "2 axes"
    assert [listing_text(items) for items in ([], ["a", "b", "c"])] == ["", "a, b and c"]
    assert listing_text("abcde", 3) == "a, b and 3 others"
    ranked = rank_names({"a": 2, "b": 3, "c": 1, "d": 2}, "least", "most")
    assert list(ranked.items()) == [("c", "least"), ("b", "most"), ("a", ""), ("d", "")]
    seconds = (12.34, 192.0, 7 * 3600.0, 123 * 3600.0)
    assert [duration_text(s) for s in seconds] == ["12.3 s", "3.2 min", "7 h", "5.12 days"]
