"""Plants whose mirror moves slowly."""

from support.plants import lbt_axis_plant

import lbt_synth as lbt


def shell(bandwidth_hz=100.0, **changes):
    facts = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": bandwidth_hz}
    return lbt.models.PositionLoop.from_bandwidth(**{**facts, **changes})


def slow_plant(delay=2.0, mirror=None, modes=1, **changes):
    base = lbt_axis_plant(modes=modes)
    models = {"turbulence": base.turbulence, "vibrations": base.vibrations, "noise_nm": 15.5}
    path = {"frame_rate_hz": 800, "delay_frames": delay, "modes": modes, "mirror": mirror}
    return lbt.tip_tilt_plant(**{**path, **models, **changes})
