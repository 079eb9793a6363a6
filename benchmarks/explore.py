"""Time from a slider to its curves on the page of `lbt-synth explore`, in headless Chromium.

Needs Debian's chromium and chromium-driver, and selenium (``make browser`` installs it); run it
from the repository::

    python benchmarks/explore.py [METHOD...]

The loop has two axes and five lines on each. First the processor time of each step of a move; then
each slider goes over its range in steps, and the time counts from its new value to the frame after
the one in which the last figure has its new curves.
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
    judge,
    move,
    moved_knobs,
    new_view,
    show_design,
)

sys.path.insert(0, "tests")  # what opens the page is what the tests use

from support.browser import chromium
from support.configs import write_config
from support.explore import MODEL, await_verdict, choose, five_lines, served

STEPS = 12
TIMED = f"""
const [name, part, done] = arguments, slider = {MODEL}(name), start = performance.now();
const figure = {MODEL}("explore-rejection"), source = figure.renderers[1].data_source;
const timed = () => {{
  source.properties.data.change.disconnect(timed);
  requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - start)));
}};
source.properties.data.change.connect(timed);
slider.value = slider.start + part * (slider.end - slider.start);
"""


def processor(path: Path, method: str) -> None:
    """Print the processor time of the steps of one move."""
    exploration = explore(lbt.load_config(path), {})
    start = exploration.config
    wish = method, {"gain": 0.9, "noise": 20.0}
    view = new_view(exploration, *wish)
    steps = {
        "configuration": lambda: move(start, method, moved_knobs(exploration, *wish)),
        "certified design": lambda: view.config.design(view.request),
        "what is shown": lambda: show_design(view.design, view.config, start, 0.0),
        "verdict": lambda: judge(view),
    }
    for name, step in steps.items():
        times = []
        for _ in range(3 if name == "verdict" else STEPS):
            begin = time.thread_time()
            step()
            times.append(1e3 * (time.thread_time() - begin))
        print(f"  {name:24s} {median(times):12.1f} ms of the processor")


def page(browser, method: str) -> None:
    """Print the times of the sliders that move any design."""
    every = []
    for key in ("delay", "gain", "noise", "shift", "seeing", "wind", "damping"):
        parts = [0.3 + 0.4 * i / STEPS for i in range(STEPS)]
        times = [browser.execute_async_script(TIMED, key, part) for part in parts]
        every += times
        print(f"  {key:24s} {median(times):12.0f}", flush=True)
    within = quantiles(every, n=10)[-1]
    print(f"  {'all sliders':24s} {median(every):12.0f}   (9 of 10 within {within:.0f} ms)")


if __name__ == "__main__":
    methods = sys.argv[1:] or ["kalman", "hinf"]
    with tempfile.TemporaryDirectory() as folder:
        config = write_config(Path(folder), five_lines())
        browser = chromium(Path(folder) / "profile", "localhost", requests=False)
        with served(config, folder=folder) as address:
            browser.set_window_size(1400, 1000)
            browser.get(address)
            await_verdict(browser)
            for method in methods:
                load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
                print(f"{method}: medians of {STEPS}, {load}")
                processor(config, method)
                if method != "kalman":
                    choose(browser, method)
                print(f"  {'':24s} {'curves [ms]':>12s}")
                page(browser, method)
        browser.quit()
