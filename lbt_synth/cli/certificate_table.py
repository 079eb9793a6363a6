"""A certificate as a table and as data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from lbt_synth.cli.output import TableText
from lbt_synth.design import Certificate, Check


def certificate_table(certificate: Certificate) -> TableText:
    """Return the checks of a certificate as a table."""
    return TableText(
        title="Certificate",
        headings=("check", "value", "limit", "passed", "computed by"),
        rows=[(c.name, c.value, c.limit, c.passed, c.computed_by) for c in certificate.checks],
    )


def check_records(checks: Iterable[Check]) -> list[dict[str, Any]]:
    """Return checks for JSON."""
    return [asdict(check) | {"passed": check.passed} for check in checks]
