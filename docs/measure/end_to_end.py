"""End-to-end figures quoted in the documentation: leak, gain with the vibration, SPECULA's clamp.

Needs the extra e2e; run with ``python docs/measure/end_to_end.py leak|gain|noise [CACHE]``.
"""

import sys
from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.endtoend import optics

CACHE = sys.argv[2] if len(sys.argv) > 2 else None
SETUP = replace(lbt.load_config("examples/lbt.yaml").end_to_end, frames=800)
STILL = replace(SETUP, vibrations=())


def mean(runs: list[lbt.EndToEndRun]) -> str:
    strehls = [100 * run.strehl for run in runs]
    gains = [run.tip_tilt_gain for run in runs]
    noise = [run.tip_tilt_noise_nm for run in runs]
    return (
        f"Strehl ratio {np.mean(strehls):.1f} % ({', '.join(f'{s:.1f}' for s in strehls)}), "
        f"optical gain {np.mean(gains):.3f}, left of tip and tilt {np.mean(noise):.1f} nm"
    )


def leaks() -> None:
    for leak in (1.0, 0.99, 0.98, 0.97, 0.95):
        runs = [replace(STILL, leak=leak, seed=s).run(None, cache=CACHE) for s in (1, 2)]
        print(f"leak {leak} from mode 50 on: {mean(runs)}", flush=True)


def gains() -> None:
    for gain in (0.5, 0.56, 0.7, 0.9, 1.1):
        runs = [replace(SETUP, seed=1).run(None, tip_tilt_gain=gain, cache=CACHE)]
        rms = np.hypot(*runs[0].rms_nm[:2])
        print(f"classical, gain {gain} with the vibration: {mean(runs)}, {rms:.0f} nm", flush=True)


def clamp() -> None:
    for value, name in ((optics.NO_CLAMP, "negative pixels kept"), (0.0, "set to zero")):
        optics.NO_CLAMP = value
        runs = [replace(STILL, seed=1).run(None, cache=CACHE)]
        print(f"{name}: {mean(runs)}", flush=True)


if __name__ == "__main__":
    {"leak": leaks, "gain": gains, "noise": clamp}[sys.argv[1]]()
