"""A report of three designs, one of which is unstable."""

import re

import pytest
from support.configs import with_errors
from support.design_reports import SMALL, three_designs

import lbt_synth as lbt


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("report")
    (place / "small.yaml").write_text(SMALL)
    return place


@pytest.fixture(scope="session")
def config(folder):
    return lbt.load_config(folder / "small.yaml")


@pytest.fixture(scope="session")
def few(folder):
    """The same with few errors and gains, for what does not depend on them."""
    text = with_errors(SMALL, -2, 2)
    (folder / "few.yaml").write_text(re.sub(r"sensor_gains: .*", "sensor_gains: [0.5, 1.0]", text))
    return lbt.load_config(folder / "few.yaml")


@pytest.fixture(scope="session")
def designs(config):
    return three_designs(config)


@pytest.fixture(scope="session")
def report(config, designs):
    return lbt.report.design_report(config, designs)


@pytest.fixture(scope="session")
def text(report, folder):
    lbt.report.write_page(lbt.report.design_page(report), folder / "a.html")
    return (folder / "a.html").read_text()
