"""Numbers and lists as texts."""

import numpy as np

from lbt_synth.report.number_text import fixed_text, number_text, signed_text, unbroken_text


def test_numbers_as_texts():
    assert [
        number_text(v) for v in (0.0, 27.701, 1234.56, 123456.0, 1e-9, -2.5, np.inf, np.nan)
    ] == ["0", "27.7", "1235", "123456", "1e\u22129", "\u22122.5", "∞", "\u2013"]
    assert fixed_text(-0.001, 1) == "0.0"
    assert fixed_text(float("nan"), 1) == "\u2013"
    assert fixed_text(float("-inf"), 1) == "\u2212∞"
    assert signed_text(0.5) == "+0.5"
    assert signed_text(0.0) == "0"
    assert number_text(-0.0) == "0"


def test_a_number_and_its_error_stay_in_one_line():
    assert unbroken_text("1 ± 2 (3 to 4)") == "1\u00a0±\u00a02 (3\u00a0to\u00a04)"
    assert unbroken_text("-1 +- 2") == "\u22121\u00a0±\u00a02"
    assert unbroken_text("-3.1e-08, 1e-6, a-b") == "\u22123.1e\u221208, 1e\u22126, a-b"
    assert unbroken_text("tomorrow is not together") == "tomorrow is not together"
