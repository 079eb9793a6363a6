"""A small configuration, designs for it, and what tests read out of their report."""

import re
from dataclasses import replace

from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.report.designs import report_page
from lbt_synth.report.page.html import Notice
from lbt_synth.storage.tables import Table

SMALL = re.sub(
    r"errors_hz: .*",
    "errors_hz: [-3.5, 3.5]\n  sensor_gains: [0.3, 0.5, 1.0, 1.3]",
    LBT_YAML.read_text().replace("frames: 8000", "frames: 1000").replace("cases: 4", "cases: 2"),
)


def words_of(report):
    """All texts of the page of a report but those of its charts."""
    blocks = report_page(report, {}).blocks
    texts = [getattr(block, "text", block) for block in blocks if type(block) in (str, Notice)]
    tables = [block for block in blocks if isinstance(block, Table)]
    return " ".join(texts + [c.text for table in tables for row in table.cells() for c in row])


def three_designs(config):
    """A Kalman filter, an integrator, and one whose loop is unstable."""
    slow = lbt.integrator(config.hardware, gain=0.4)
    return {
        "kalman": lbt.kalman(config.plant),
        "slow": slow,
        "wild": replace(slow, claims={"gain": 1.5}),  # unstable at gains above 2/3
    }
