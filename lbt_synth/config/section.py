"""A section of a configuration, from which others are derived."""

from __future__ import annotations

from typing import Self

from lbt_synth.methods.method import Section as MethodSection


class Section(MethodSection):
    """A section of a configuration, whose builders declare which numbers may vary."""

    @property
    def per_sample(self) -> Self:
        """The same section, read by a builder that takes its numbers for each of many samples.

        Builders declare thus which numbers may be arrays; see ``config.samples``.
        """
        return self

    def require_one_value(self) -> None:
        """Declare that samples evaluated together must have the same numbers in this section."""
