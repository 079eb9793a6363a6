"""Screenshot of a report at the width of a desk, and its size.

    python benchmarks/report.py out/report.html docs/figures/report.png

Needs Debian's chromium and chromium-driver, and selenium (the dependency group browser).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from selenium import webdriver

OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
)


def main(page: str, figure: str) -> None:
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    with tempfile.TemporaryDirectory() as profile:
        for option in (
            *OPTIONS,
            f"--user-data-dir={profile}",
            "--window-size=1150,1660",
            "--hide-scrollbars",
        ):
            options.add_argument(option)
        service = webdriver.ChromeService(executable_path="/usr/bin/chromedriver")
        driver = webdriver.Chrome(options=options, service=service)
        driver.get(Path(page).resolve().as_uri())
        driver.save_screenshot(figure)
        driver.quit()
    print(f"{Path(page).stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
