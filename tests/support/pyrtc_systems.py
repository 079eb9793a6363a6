"""Systems of pyRTC, started from exported folders under stream names of their own."""

from __future__ import annotations

import itertools
import os
import signal
from contextlib import contextmanager

import numpy as np
import yaml

from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise

_NUMBERS = itertools.count()
_LONGEST_S = 60


@contextmanager
def running(folder, *, predictor=None, training=None, own_process=False):
    """Start a folder's system and yield its telescope and its loop; end it, whatever happens.

    Another predictor takes the place of ours; a training series is what it is fitted to.
    """
    import pyshmem
    from pyrtc.manager import RTCManager

    conf = yaml.safe_load((folder / "config.yaml").read_text())
    signal_name, wfc_name = streams = [
        f"lbt_{os.getpid()}_{next(_NUMBERS)}_{kind}" for kind in ("signal", "wfc")
    ]
    conf["slopes"] |= {"output_streams": {"signal": signal_name}}
    conf["slopes"] |= {"input_streams": {"wfc": wfc_name}}
    conf["wfc"] |= {"output_streams": {"wfc": wfc_name}}
    conf["loop"] |= {
        "input_streams": {"signal": signal_name},
        "output_streams": {"wfc": wfc_name},
    }
    conf["loop"]["predictor"] = conf["loop"]["predictor"] if predictor is None else predictor
    if own_process:
        conf["manager"]["component_modes"] = {"loop": "hard-rtc"}
    path = folder / f"{signal_name}.yaml"
    path.write_text(yaml.safe_dump(conf))
    before = signal.signal(signal.SIGALRM, _give_up)
    signal.alarm(_LONGEST_S)
    manager = RTCManager.from_config_file(path)
    try:
        manager.build()
        if training is not None:
            manager.get_component("loop").fit_predictor(training)
        manager.start()
        yield manager.get_component("slopes"), manager.get_component("loop")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        children = [getattr(runtime, "launcher", None) for runtime in manager.runtimes.values()]
        processes = [child.process for child in children if child is not None]
        manager.close()
        for process in processes:
            process.kill()
            process.wait()
            process.stdin.close()
            process.stdout.close()
        for name in streams:
            pyshmem.unlink_quiet(name)


def _give_up(*_):
    raise TimeoutError(f"pyRTC ran for more than {_LONGEST_S} s")


def drawn(truth, hardware, *, frames, seed, quiet=0):
    """Phase and noise, (1, frames, modes); both are zero in the first frames."""
    rng = np.random.default_rng(seed)
    size = {"frames": frames, "cases": 1}
    total = draw_disturbance(truth, hardware, rng=rng, **size)
    noise = draw_noise(truth, hardware, rng=rng, **size)
    total[:, :quiet] = 0
    noise[:, :quiet] = 0
    return total, noise


def pol_series(truth, hardware, *, frames, seed):
    """What an open loop records, (frames, modes)."""
    total, noise = drawn(truth, hardware, frames=frames, seed=seed)
    return (total + noise)[0]


def residual_rms(series, modes=2):
    """Residual over all modes [nm rms], of a series of the loop."""
    return float(np.sqrt(np.sum(np.var(series[0, :, :modes], axis=0))))
