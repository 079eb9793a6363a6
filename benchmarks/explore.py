"""Time from a slider to its curves on the page of `lbt-synth explore`, in headless Chromium.

    python benchmarks/explore.py

It needs what the tests in a browser need (``make browser``). The loop has five lines on two axes.
Each slider goes over its range in steps; the time counts from its event to the second frame after
its curves have come, and after the Strehl ratio, which comes last.
"""

import sys
import tempfile
from pathlib import Path
from statistics import median, quantiles

import lbt_synth as lbt
from lbt_synth.report.explore import list_knobs

sys.path.insert(0, "tests")  # what opens the page is what the tests use

from support.browser import chromium
from support.configs import write_config
from support.explore import await_verdict, choose, five_lines, press, served

STEPS = 12
MOVE = """
const [name, part, done] = arguments, find = (name) => Bokeh.documents[0].get_model_by_name(name);
const slider = find(name), times = [], start = performance.now();
["Rejection", "Strehl ratio"].forEach((title, which) => {
  const data = find(title).renderers.at(-1).data_source.properties.data.change;
  data.connect(function come() {
    data.disconnect(come);
    requestAnimationFrame(() => requestAnimationFrame(() => {
      times[which] = performance.now() - start;
      if (times[0] && times[1]) done(times);
    }));
  });
});
slider.value = slider.start + part * (slider.end - slider.start);
"""


def page(browser, method: str, sliders: list[str]) -> None:
    """Print the times of the sliders of a method."""
    every = []
    for name in sliders:
        parts = (0.3 + 0.4 * step / STEPS for step in range(STEPS))
        times = [browser.execute_async_script(MOVE, name, part) for part in parts]
        every += times
        print("  {:12s} {:6.0f} {:6.0f}".format(name, *map(median, zip(*times, strict=True))))
        press(browser, "reset")
        await_verdict(browser)
    curves, whole = zip(*every, strict=True)
    most = quantiles(curves, n=10)[-1]
    print(f"{method}: curves {median(curves):.0f} ms (9 of 10 within {most:.0f} ms),", end=" ")
    print(f"all {median(whole):.0f} ms", flush=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        config = write_config(Path(folder), five_lines())
        names = [knob.key for knob in list_knobs(lbt.load_config(config))]
        browser = chromium(Path(folder) / "profile", "localhost", logs=False)
        with served(config, folder=folder) as address:
            browser.set_window_size(1400, 1000)
            browser.get(address)
            await_verdict(browser)
            page(browser, "kalman", names[:-1])
            choose(browser, "hinf")
            page(browser, "hinf", names)
        browser.quit()
