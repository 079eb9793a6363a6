"""What the parser says of words that are no options of a command."""

from __future__ import annotations

import pytest
from support.commands import run


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--gama", "3"), "--gama 3; did you mean --gamma?"),
        (("--gama=3",), "--gama=3; did you mean --gamma?"),
    ],
)
def test_a_mistyped_option_is_named(capsys, words, message) -> None:
    status, text, error = run(
        capsys, "design", "a.yaml", "--method", "kalman", "-o", "a.fits", *words
    )
    assert (status, text) == (2, "")
    assert f"unrecognized arguments: {message}" in error


def test_a_second_output_is_refused(capsys) -> None:
    words = ("--method", "kalman", "-o", "a.fits")
    for more in ("-o", "--output"):
        status, _, error = run(capsys, "design", "a.yaml", *words, more, "b.fits")
        assert status == 2
        assert "argument -o/--output: give it once" in error
