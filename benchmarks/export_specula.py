"""Load files into SPECULA's own filters and step them beside our controller.

Needs the extra ``e2e`` (``make e2e`` installs it); from the repository::

    python benchmarks/export_specula.py {double,single} GAIN.fits [TRANSFER_FUNCTIONS.fits]

The gain file is given to SsrFilter, the transfer functions (``lbt-synth export --for iir``)
to IirFilter. Printed: the largest difference of the commands over the largest command, in the
closed loop of examples/lbt.yaml and on 150 random measurements.
"""

import sys

import numpy as np

sys.path.insert(0, "tests")  # what drives SPECULA is what the tests use

from support.specula_filters import commands, noise_series, relative, simulated

import lbt_synth as lbt

CONFIG = "examples/lbt.yaml"

if __name__ == "__main__":
    precision, gain, *transfer = sys.argv[1:]
    controller = lbt.load_gain(gain).controller
    run = controller.start()
    loop = simulated(controller, CONFIG)
    noise = np.array([run.step(y) for y in noise_series(controller.B.shape[1])])
    named = [f"ssr:{gain}", *(f"iir:{file}" for file in transfer)]
    found = commands(("double", "single").index(precision), CONFIG, named)
    for text, (their_loop, their_noise) in zip(named, found, strict=True):
        print(
            f"{text}, {precision}: loop {relative(their_loop, loop):.1e}, "
            f"random measurements {relative(their_noise, noise):.1e}"
        )
