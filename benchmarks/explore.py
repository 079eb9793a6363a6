"""Time from a slider to its curves on the page of `lbt-synth explore`, in headless Chromium.

Needs Debian's chromium and chromium-driver, and selenium (``make browser`` installs it); run it
from the repository::

    python benchmarks/explore.py [METHOD...]

The loop has two axes and five lines on each. First the processor time of each step of a move; then
each slider goes over its range in steps, and the time counts from the event of the slider to the
frame after the paint of the curves that follow from it, and of all: the Strehl curve and the table
come last.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import median, quantiles

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import (
    explore,
    fulfil,
    judge,
    loop_curves,
    quick_view,
    whole_view,
)

sys.path.insert(0, "tests")  # what opens the page is what the tests use

from support.browser import chromium
from support.configs import write_config
from support.explore import await_state, choose, five_lines, move, reset, served

STEPS = 12


def processor(path: Path, method: str) -> None:
    """Print the processor time of the steps of one move."""
    exploration = explore(lbt.load_config(path), {})
    wish = method, {"gain": 0.9, "noise": 20.0}
    view = quick_view(exploration, *wish)
    whole = whole_view(exploration, view)
    steps = {
        "configuration": lambda: fulfil(*wish, exploration.knobs, exploration.config),
        "certified design": lambda: view.config.design(view.request),
        "curves": lambda: loop_curves(view.design, view.config),
        "Strehl curve, residual": lambda: whole_view(exploration, view),
        "verdict": lambda: judge(whole),
    }
    for name, step in steps.items():
        times = []
        for _ in range(3 if name == "verdict" else STEPS):
            start = time.thread_time()
            step()
            times.append(1e3 * (time.thread_time() - start))
        print(f"  {name:24s} {median(times):12.1f} ms of the processor")


def page(browser, method: str) -> None:
    """Print the times of all sliders of a method."""
    keys = browser.execute_script(
        "return [...document.querySelectorAll('.knob:not([hidden]) input')].map(e => e.id)"
    )
    every = []
    for key in keys:
        times = [move(browser, key, 0.3 + 0.4 * i / STEPS) for i in range(STEPS)]
        every += times
        first, last = (median(column) for column in zip(*times, strict=True))
        print(f"  {key:24s} {first:12.0f} {last:9.0f}", flush=True)
        reset(browser)
    curves = [first for first, _ in every]
    print(
        f"  {'all sliders':24s} {median(curves):12.0f} {median(last for _, last in every):9.0f}   "
        f"(9 of 10 curves within {quantiles(curves, n=10)[-1]:.0f} ms)"
    )


if __name__ == "__main__":
    methods = sys.argv[1:] or ["kalman", "hinf"]
    with tempfile.TemporaryDirectory() as folder:
        config = write_config(Path(folder), five_lines())
        browser = chromium(Path(folder) / "profile", "localhost", requests=False)
        with served(config, folder=folder) as address:
            browser.set_window_size(1400, 1000)
            browser.get(address)
            await_state(browser, "judged", 0)
            for method in methods:
                load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
                print(f"{method}: medians of {STEPS}, {load}")
                processor(config, method)
                choose(browser, method)
                print(f"  {'':24s} {'curves [ms]':>12s} {'all [ms]':>9s}")
                page(browser, method)
        browser.quit()
