"""The band of frequencies from which terms and demands derive."""

from __future__ import annotations

from dataclasses import dataclass

from lbt_synth.validation import number


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Band from ``low_hz`` to ``high_hz``, both included.

    Raises
    ------
    ProblemError
        If the ends are no numbers of at least 0 in increasing order.
    """

    low_hz: float
    high_hz: float

    def __post_init__(self) -> None:
        low = number(self.low_hz, "low_hz", at_least=0)
        object.__setattr__(self, "low_hz", low)
        object.__setattr__(self, "high_hz", number(self.high_hz, "high_hz", above=low))

    @property
    def band_text(self) -> str:
        """The band in words."""
        return f"{self.low_hz:g}-{self.high_hz:g} Hz"
