"""The page of sliders, served by the command and opened in Chromium."""

import contextlib
import signal
import subprocess
import sys
import time

from support.commands import hear_interruptions
from support.configs import change_key

FIVE_LINES = ((13.0, 40.0), (20.0, 80.0), (33.0, 20.0), (48.0, 10.0), (72.5, 8.0))  # Hz, mas


def five_lines():
    """The example with five lines on both axes, which the loop meets as they are assumed."""
    lines = [
        {"axis": "both", "frequency_hz": hz, "damping": 0.005, "rms_mas": mas}
        for hz, mas in FIVE_LINES
    ]
    content = change_key(("truth", "vibrations"), "model")
    content["model"]["vibrations"] = lines
    return content


@contextlib.contextmanager
def served(config, *gains, folder):
    """Serve the page; yield its address, and end as Ctrl-C does."""
    words = ["explore", str(config), *map(str, gains), "--port", "0", "-o", str(folder)]
    command = [sys.executable, "-m", "lbt_synth.cli.main", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, preexec_fn=hear_interruptions
    ) as process:
        try:
            yield process.stdout.readline().split()[1]
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def await_state(browser, name, value, *, within_s=60):
    """Wait until the page says that it has come so far."""
    end = time.monotonic() + within_s
    while browser.execute_script(f"return document.documentElement.dataset.{name}") != str(value):
        assert time.monotonic() < end, browser.get_log("browser")
        time.sleep(0.05)


MOVE = """
const [id, part, final, done] = arguments, root = document.documentElement;
const knob = document.getElementById(id);
knob.value = Math.round(part * Number(knob.max));
const start = performance.now();
const times = {};
const watch = new MutationObserver(() => {
  for (const name of ["shown", "whole"])
    if (root.dataset[name] === wanted && !(name in times)) times[name] = performance.now() - start;
  if ("whole" in times) { watch.disconnect(); done([times.shown ?? times.whole, times.whole]); }
});
const wanted = String(Number(root.dataset.asked || 0) + 1 + Number(final));
watch.observe(root, { attributes: true });
knob.dispatchEvent(new Event("input"));
// slow designs are made when a slider is released
if (final || root.dataset.asked !== wanted) knob.dispatchEvent(new Event("change"));
"""


def move(browser, key, part, *, final=False):
    """Move a slider to a part of its range; return the milliseconds to its curves, and to all."""
    return browser.execute_async_script(MOVE, key, part, final)


def choose(browser, method):
    """Choose a method, and wait for the verdict on its design."""
    select(browser, method)
    await_state(browser, "judged", asked(browser))


def select(browser, method):
    browser.execute_script(
        "const [name, chosen] = arguments, menu = document.getElementById(name);"
        "menu.value = chosen; menu.dispatchEvent(new Event('change'))",
        "method",
        method,
    )


def reset(browser):
    """Put all sliders back, and wait for the verdict."""
    before = asked(browser)
    browser.execute_script("document.getElementById('controls').reset()")
    await_state(browser, "asked", before + 1)
    await_state(browser, "judged", before + 1)


def asked(browser):
    """Return the number of the last wish."""
    return int(browser.execute_script("return document.documentElement.dataset.asked || 0"))
