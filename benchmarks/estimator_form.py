"""What clipping and opening leave behind, in both forms of a controller.

From the repository::

    python benchmarks/estimator_form.py [EPISODES]

Each episode clips the commands of a settled loop, opens it, or holds the mirror for up to 400
frames, at a random sensor gain. A loop is back when its residual stays within 1 % (of the rms)
of that of the same loop without the episode. The settling time is that of the loop, to 1e-4.
"""

from __future__ import annotations

import sys

import numpy as np

sys.path.insert(0, "tests")
from support.episodes import Episodes, frames_to_come_back

import lbt_synth as lbt

GAINS = {"kalman": 0.5, "hinf": 0.7, "lqg": 0.5, "integrator": 0.5, "robust": 0.358}


def main() -> None:
    """Print a row per design and form."""
    count = int(sys.argv[1]) if sys.argv[1:] else 2000
    plain, robust = (lbt.load_config(f"examples/{name}.yaml") for name in ("lbt", "lbt_robust"))
    print("| design | form | back within 2 settling times | slowest, in settling times |")
    print("|---|---|---:|---:|")
    for name, least in GAINS.items():
        design = (robust if name == "robust" else plain).design(name)
        episodes = Episodes.draw(design, count, np.random.default_rng(1), (least, 1.0))
        for form in ("estimator", "plain"):
            found = frames_to_come_back(design, episodes, given=form == "estimator")
            times = found / episodes.settling
            back, slowest = int(np.sum(times <= 2)), np.max(times)
            words = f"{slowest:.2f}" if np.isfinite(slowest) else "more than 3"
            print(f"| {name} | {form} | {back} of {count} | {words} |", flush=True)


if __name__ == "__main__":
    main()
