"""Load a gain file into SPECULA's state-space filter and step both side by side.

Needs ``pip install specula``; run with ``python docs/measure/specula_filter.py gain.fits``.
"""

import sys

import numpy as np
import specula

import lbt_synth as lbt

specula.init(-1, precision=0)  # the CPU, double precision

from specula.data_objects.ssr_filter_data import SsrFilterData  # noqa: E402
from specula.processing_objects.ssr_filter import SsrFilter  # noqa: E402

if __name__ == "__main__":
    data = SsrFilterData.restore(sys.argv[1])
    theirs = SsrFilter(data)
    theirs._gain_mod = 1.0
    ours = lbt.load_gain(sys.argv[1]).controller.start()
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(1000):
        theirs.delta_comm = rng.normal(size=data.nfilter)
        theirs.trigger_code()
        apart = theirs.output_buffer[:, 0] - ours.step(theirs.delta_comm)
        worst = max(worst, float(np.max(np.abs(apart))))
    print(f"{data.nfilter} inputs, {data.total_states} states, new state "
          f"{theirs.output_uses_new_state}: commands differ by {worst:.1e}")  # fmt: skip
