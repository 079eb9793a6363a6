"""Pages in headless Chromium, as a desk or a phone shows them."""

import time

OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
OPTIONS += ("--disable-background-networking", "--disable-component-update", "--disable-sync")
OPTIONS += ("--disable-dev-shm-usage",)
PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}

DESK = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}

# elements in the page and in shadow roots below one
WALK = """
function* walk(node) {
  yield node;
  if (node.shadowRoot) for (const child of node.shadowRoot.children) yield* walk(child);
  for (const child of node.children) yield* walk(child);
}
"""


def chromium(profile, *hosts, requests=True):
    """Start headless Chromium, to which no names are known but those of hosts.

    It lists the requests of its pages, which takes time from whatever is measured.
    """
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    rules = ", ".join(["MAP * ~NOTFOUND", *(f"EXCLUDE {host}" for host in hosts)])
    for option in (*OPTIONS, f"--host-resolver-rules={rules}", f"--user-data-dir={profile}"):
        options.add_argument(option)
    logs = {"browser": "ALL"} | ({"performance": "ALL"} if requests else {})
    options.set_capability("goog:loggingPrefs", logs)
    service = webdriver.ChromeService(executable_path="/usr/bin/chromedriver")
    return webdriver.Chrome(options=options, service=service)


def opened(browser, address, screen=DESK, *, script=True):
    """Open a page, wait until its charts are drawn, and return all that was requested."""
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": screen["mobile"]})
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": not script})
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(address)
    end = time.monotonic() + 60
    while (
        script and browser.execute_script("return document.documentElement.dataset.drawn") != "yes"
    ):
        assert time.monotonic() < end, browser.get_log("browser")
        time.sleep(0.1)
    time.sleep(0.5)


def chain(browser):
    """Return what the hand does next."""
    from selenium.webdriver import ActionChains

    return ActionChains(browser)


def drawn_plots(browser):
    """For each plot its size, and how many of its pixels are not blank."""
    return browser.execute_script(
        WALK
        + """
        return [...document.querySelectorAll(".plot")].map(place => {
          let ink = 0, box = place.getBoundingClientRect();
          for (const node of walk(place)) {
            if (node.tagName !== "CANVAS" || !node.width) continue;
            const data = node.getContext("2d").getImageData(0, 0, node.width, node.height).data;
            for (let i = 0; i < data.length; i += 4)
              if (data[i + 3] > 128 && data[i] + data[i + 1] + data[i + 2] < 720) ink += 1;
          }
          return [place.id, box.width, box.height, ink];
        });
        """
    )


def tooltips(browser):
    return browser.execute_script(
        WALK
        + """
        const found = [];
        for (const node of walk(document.body))
          if (node.classList && node.classList.contains("bk-Tooltip") && node.offsetHeight)
            found.push([...walk(node)].filter(e => e.tagName !== "STYLE").map(e => [...e.childNodes].filter(c => c.nodeType === 3)
              .map(c => c.textContent).join("")).join(" "));
        return found;
        """
    )
