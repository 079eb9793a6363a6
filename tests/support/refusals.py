"""Refusals: a call, the error that it raises, and its words, one row of a table each."""

import pytest


def refused(call, error, words):
    """Return the error that a call raises, of a class and with words that match."""
    with pytest.raises(error, match=words) as caught:
        call()
    return caught.value


def require_refusals(rows):
    """Call each row of (call, error, words), which must raise that error with those words."""
    for call, error, words in rows:
        refused(call, error, words)
