"""Pages and a browser that the tests of pages share."""

import pytest
from support.browser import chromium
from support.pages import HOSTILE, whole_page
from support.study_pages import page_of, results

import lbt_synth as lbt
from lbt_synth.report.page.html import page_html


@pytest.fixture(scope="session")
def pages(small_config, small_designs, tmp_path_factory):
    """Addresses of a real report, a study, and a page with every kind of mark and hostile names."""
    folder, (kalman, slow, _) = tmp_path_factory.mktemp("browser"), small_designs.values()
    designs = {"kalman": kalman, "integrator with a rather long name of its file": slow}
    page = lbt.report.design_page(small_config, designs)
    lbt.report.write_page(page, folder / "report.html")
    (folder / "study.html").write_bytes(page_html(page_of(results())))
    (folder / "marks.html").write_bytes(page_html(whole_page()))
    (folder / "hostile.html").write_bytes(page_html(whole_page(HOSTILE)))
    return {path.stem: path.as_uri() for path in folder.glob("*.html")}


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    pytest.importorskip("selenium")
    driver = chromium(tmp_path_factory.mktemp("profile"))
    driver.execute_cdp_cmd("Network.enable", {})
    driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["http://*", "https://*", "ws://*"]})
    offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    driver.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
    yield driver
    driver.quit()
