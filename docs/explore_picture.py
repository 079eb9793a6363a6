"""Take the pictures of the page of sliders: ``python docs/explore_picture.py``.

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
from support.explore import asked, await_state, choose, five_lines, move, served

SIZES = {"explore": (1400, 1330), "explore_phone": (390, 844)}
COLOURS = 64

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        browser = chromium(Path(folder) / "profile", "localhost")
        config = write_config(Path(folder), five_lines()).rename(Path(folder) / "five_lines.yaml")
        with served(config, folder=folder) as address:
            for name, (width, height) in SIZES.items():
                size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
                browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
                browser.get(address)
                await_state(browser, "judged", 0)
                browser.find_element("id", "keep").click()
                choose(browser, "hinf")
                move(browser, "shift", 0.6, final=True)
                await_state(browser, "judged", asked(browser))
                picture = Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB")
                small = picture.quantize(COLOURS, dither=Image.Dither.NONE)
                small.save(Path("docs/figures") / f"{name}.png", optimize=True)
        browser.quit()
