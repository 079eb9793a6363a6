"""Take the picture of the page of sliders: ``python docs/explore_picture.py``.

Run it from the repository. It needs what the tests in a browser need (``make browser``).
"""

import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image

sys.path.insert(0, "tests")  # what opens the page is what the tests use

from support.browser import chromium
from support.configs import write_config
from support.explore import await_verdict, choose, five_lines, move, press, served

SIZE = {"width": 1400, "height": 1060, "deviceScaleFactor": 1, "mobile": False}
COLOURS = 64

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        browser = chromium(Path(folder) / "profile", "localhost")
        config = write_config(Path(folder), five_lines()).rename(Path(folder) / "five_lines.yaml")
        with served(config, folder=folder) as address:
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", SIZE)
            browser.get(address)
            await_verdict(browser)
            press(browser, "keep")
            choose(browser, "hinf")
            move(browser, "shift", 0.6)
            picture = Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB")
            small = picture.quantize(COLOURS, dither=Image.Dither.NONE)
            small.save(Path("docs/figures") / "explore.png", optimize=True)
        browser.quit()
