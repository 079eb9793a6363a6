"""SPECULA's state-space filter, as its simulation drives it, in a process of one precision."""

import sys

import numpy as np

import lbt_synth as lbt

FRAMES, SEED, NOISE_FRAMES = 2000, 5, 150
_STEP_S = 1 / 800


def noise_series(inputs: int) -> np.ndarray:
    """Measurements that no loop gave; an unstable controller grows on them."""
    return 100 * np.random.default_rng(7).standard_normal((NOISE_FRAMES, inputs))


class Triggered:
    """A filter of SPECULA behind ``step`` and ``reset``: inputs set, checked, triggered."""

    def __init__(self, make, inputs):
        from specula.base_value import BaseValue

        self.make, self.inputs, self.value = make, inputs, BaseValue
        self.reset()

    def reset(self):
        self.filter = self.make()
        self.measured = self.value(value=np.zeros(self.inputs))
        self.filter.inputs["delta_comm"].set(self.measured)
        self.filter.setup()
        self.frame = 0

    def step(self, y):
        t = self.filter.seconds_to_t(self.frame * _STEP_S)
        self.frame += 1
        self.measured.set_value(y)
        self.measured.generation_time = t
        assert self.filter.check_ready(t)
        self.filter.trigger()
        self.filter.post_trigger()
        command = self.filter.outputs["out_comm"]
        assert command.generation_time == t
        return np.array(command.value, dtype=np.float64)


def commands(precision, config, files):
    """Commands of each gain file, in the loop of a configuration and on given measurements."""
    import specula

    specula.init(-1, precision=precision)
    from specula.data_objects.ssr_filter_data import SsrFilterData
    from specula.processing_objects.ssr_filter import SsrFilter

    results = []
    for file in files:
        data = SsrFilterData.restore(file)
        assert data.dtype == (np.float64, np.float32)[precision]
        theirs = Triggered(lambda d=data: SsrFilter(d), data.nfilter)
        loop = simulate_commands(theirs, config)
        theirs.reset()
        results.append((loop, [theirs.step(y) for y in noise_series(data.nfilter)]))
    return results


def simulate_commands(controller, config):
    loaded = lbt.load_config(config)
    options = {"frames": FRAMES, "seed": SEED, "settle_frames": 0}
    return lbt.simulate(controller, loaded.truth, hardware=loaded.hardware, **options).commands[0]


def main(precision, output, config, *files):
    loops, noises = zip(*commands(int(precision), config, files), strict=True)
    named = {f"loop{i}": loop for i, loop in enumerate(loops)}
    np.savez(output, **named, **{f"noise{i}": noise for i, noise in enumerate(noises)})


if __name__ == "__main__":
    main(*sys.argv[1:])
