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


MODEL = "Bokeh.documents[0].get_model_by_name"
READY = f"return Boolean(window.Bokeh && Bokeh.documents[0] && {MODEL}('verdict'))"
SET = f"""
const [name, field, part, final] = arguments, widget = {MODEL}(name);
const value = field === "value" && typeof part === "number"
  ? widget.start + part * (widget.end - widget.start) : part;
widget.value = value;
if (final) widget.value_throttled = value;
"""


def text_of(browser, name):
    return browser.execute_script(f"return {MODEL}(arguments[0]).text", name)


def await_true(condition, *, within_s=60):
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def await_verdict(browser):
    """Wait until the page has said what it thinks of its design, and return that."""
    await_true(lambda: browser.execute_script(READY.replace("Boolean", "!!")))
    await_true(lambda: text_of(browser, "verdict") not in ("", "Designing …"))
    return text_of(browser, "verdict")


def move(browser, key, part, *, final=True):
    """Move a slider to a part of its range and release it; return the verdict, a new one."""
    said = text_of(browser, "verdict")
    browser.execute_script(SET, key, "value", part, final)
    await_true(lambda: text_of(browser, "verdict") not in (said, "", "Designing …"))
    return text_of(browser, "verdict")


def choose(browser, method):
    return move(browser, "method", method, final=False)


def press(browser, name):
    event = "new (Bokeh.require('core/bokeh_events').ButtonClick)()"
    browser.execute_script(f"{MODEL}(arguments[0]).trigger_event({event})", name)
