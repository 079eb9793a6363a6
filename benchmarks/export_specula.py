"""Load a gain file into SPECULA's own SsrFilter and step it beside our controller.

Needs the extra ``e2e`` (``make e2e`` installs it); from the repository::

    python benchmarks/export_specula.py {double,single} GAIN.fits

Printed: the largest difference of the commands over the largest command, in the closed loop of
examples/lbt.yaml and on 150 random measurements.
"""

import sys

import numpy as np

sys.path.insert(0, "tests")  # what drives SPECULA is what the tests use

from support.exports import relative
from support.specula_filters import commands, noise_series, simulate_commands

import lbt_synth as lbt

CONFIG = "examples/lbt.yaml"

if __name__ == "__main__":
    precision, gain = sys.argv[1:]
    controller = lbt.load_gain(gain).controller
    run = controller.start()
    noise = np.array([run.step(y) for y in noise_series(controller.B.shape[1])])
    loop = simulate_commands(controller, CONFIG)
    ((their_loop, their_noise),) = commands(("double", "single").index(precision), CONFIG, [gain])
    print(
        f"{gain}, {precision}: loop {relative(their_loop, loop):.1e}, "
        f"random measurements {relative(their_noise, noise):.1e}"
    )
