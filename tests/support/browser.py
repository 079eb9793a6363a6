"""Pages in headless Chromium, as a desk or a phone shows them."""

OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
OPTIONS += ("--disable-background-networking", "--disable-component-update", "--disable-sync")
OPTIONS += ("--disable-dev-shm-usage",)
PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}

DESK = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}


def chromium(profile, *hosts, logs=True):
    """Start headless Chromium, to which no names are known but those of hosts.

    Its logs take time from whatever is measured.
    """
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    rules = ", ".join(["MAP * ~NOTFOUND", *(f"EXCLUDE {host}" for host in hosts)])
    for option in (*OPTIONS, f"--host-resolver-rules={rules}", f"--user-data-dir={profile}"):
        options.add_argument(option)
    if logs:
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(executable_path="/usr/bin/chromedriver")
    return webdriver.Chrome(options=options, service=service)


def opened(browser, address, screen=DESK):
    """Open a page and wait for all of it, though it was open already; its log begins with it."""
    from selenium.webdriver.support.ui import WebDriverWait

    browser.get("about:blank")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": screen["mobile"]})
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(address)
    complete = "return location.href !== 'about:blank' && document.readyState === 'complete'"
    WebDriverWait(browser, 60).until(lambda driver: driver.execute_script(complete))
