"""Systems of pyRTC, started from exported folders under stream names of their own."""

import itertools
import os
import signal
from contextlib import contextmanager

import numpy as np
import pytest
import yaml

from lbt_synth.loop.disturbances import draw_disturbance

_NUMBERS = itertools.count()
_LONGEST_S = 300
SENSOR_HZ = 100.0  # of pyRTC's own sensor


@contextmanager
def running(folder, *, predictor=None, training=None, own_process=False):
    """Start a folder's system with our predictor, or one that is fitted to a series; end it."""
    conf = yaml.safe_load((folder / "config.yaml").read_text())
    conf["loop"]["predictor"] = conf["loop"]["predictor"] if predictor is None else predictor
    if own_process:
        conf["manager"]["component_modes"] = {"loop": "hard-rtc"}
    with built(folder, conf) as manager:
        if training is not None:
            manager.get_component("loop").fit_predictor(training)
        manager.start()
        yield manager.get_component("slopes"), manager.get_component("loop")


@contextmanager
def synthetic(folder):
    """Yield the manager of a folder's loop, calibrated on pyRTC's own sensor in calm air."""
    conf = yaml.safe_load((folder / "config.yaml").read_text())
    grid = {"sub_ap_spacing": 8, "sub_ap_offset_x": 0, "sub_ap_offset_y": 0}
    conf["wfs"] = {"class_name": "SyntheticSHWFS", "functions": ["expose"], "name": "sensor"}
    conf["wfs"] |= {"width": 32, "height": 32, "dark_count": 10, "read_noise": 1.0, **grid}
    conf["wfs"] |= {"num_modes": conf["wfc"]["num_modes"], "frame_rate_hz": SENSOR_HZ}
    conf["slopes"] = {"type": "SHWFS", "signal_type": "slopes", "functions": ["compute_signal"]}
    conf["slopes"] |= grid
    del conf["loop"]["im_file"]
    conf["loop"] |= {"poke_amp": 0.2, "num_iters_im": 4, "im_settle_frames": 3}
    with built(folder, conf) as manager:
        sensor = manager.get_component("wfs")
        amplitudes, sensor.modal_amplitudes = sensor.modal_amplitudes, 0 * sensor.modal_amplitudes
        for part in ("wfc", "wfs", "slopes"):
            manager.start_component(part)
        manager.get_component("loop").compute_im()
        sensor.modal_amplitudes = amplitudes
        yield manager


@contextmanager
def built(folder, conf):
    """Build a system under stream names of its own, and clear it away."""
    pytest.importorskip("pyrtc")
    import pyshmem
    from pyrtc.manager import RTCManager

    prefix = f"lbt_{os.getpid()}_{next(_NUMBERS)}_"
    simulated = "signal_size" in conf["slopes"]
    roles = {
        "wfs": ("wfc", "wfs_raw wfs"),
        "slopes": ("wfc" if simulated else "wfs", "signal signal_2d"),
        "loop": ("signal", "wfc"),
        "wfc": ("", "wfc wfc_2d"),
    }
    for section, words in roles.items():
        for kind, names in zip(("input_streams", "output_streams"), words, strict=True):
            conf[section][kind] = {name: prefix + name for name in names.split()}
    path = folder / f"{prefix}.yaml"
    path.write_text(yaml.safe_dump(conf))
    before = signal.signal(signal.SIGALRM, _give_up)
    signal.alarm(_LONGEST_S)
    manager = RTCManager.from_config_file(path)
    try:
        manager.build()
        yield manager
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        children = [getattr(runtime, "launcher", None) for runtime in manager.runtimes.values()]
        processes = [child.process for child in children if child is not None]
        try:
            manager.close()
        finally:
            for process in processes:
                process.kill()
                process.wait()
                process.stdin.close()
                process.stdout.close()
            for name in ("wfs_raw", "wfs", "signal", "signal_2d", "wfc", "wfc_2d"):
                pyshmem.unlink_quiet(prefix + name)


def modal_residuals(manager, frames):
    """Residuals of the next frames in units of the commands, (frames, modes)."""
    loop, series = manager.get_component("loop"), []
    stream = loop.signal_shm
    seen = stream.count
    for _ in range(frames):
        found = stream.read_after_publication(seen, timeout=10)
        seen = found.count
        series.append(np.array(found.payload))
    return loop.modal_residuals(series)


def _give_up(*_):
    raise TimeoutError(f"pyRTC ran for more than {_LONGEST_S} s")


def drawn(truth, hardware, *, frames, seed, quiet=0):
    """Phase and noise, (1, frames, modes); both are zero in the first frames."""
    series = draw_disturbance(truth, hardware, frames=frames, seed=seed)
    for values in (series.phase_nm, series.noise):
        values[:, :quiet] = 0
    return series.phase_nm, series.noise
