"""Telemetry with everything in it, any telemetry, and their comparison."""

import dataclasses

import numpy as np
import pytest
from hypothesis import strategies as st

import lbt_synth as lbt

ENDINGS = ("fits", "npz")
SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=150, sampling_hz=24_000, ramp_samples=3
)


def full(*, frames=6, random=0, **changes):
    """Telemetry with everything in it: 2 modes, 2 commands, 3 measurements."""
    rng = np.random.default_rng(random)
    columns = {"commands": 2, "measurements": 3, "residual_nm": 2, "total_nm": 2}
    fields = {name: rng.standard_normal((frames, count)) for name, count in columns.items()}
    fields |= {
        "times_s": 1.7e9 + np.cumsum(rng.uniform(0.001, 0.002, frames)),
        "interaction_matrix": rng.standard_normal((3, 2)),
        "influence_matrix": rng.standard_normal((2, 2)),
        "metadata": {"target": "HD 1'0\n", "airmass": 1.2, "binning": 1, "night": True, "é": ""},
    }
    fields |= {"frame_rate_hz": 800.0, "delay_frames": 2.25, "mirror": SHELL, "sensor_gain": 0.358}
    fields |= {"measurement_unit": "pixel", "diameter_m": 8.22, "obstruction": 0.11}
    fields |= {"imaging_wavelength_um": 2.2, "shown_unit": "mas"}
    return lbt.files.Telemetry(**{**fields, **changes})


def same(one, other, *, but=(), rtol=0.0):
    for field in dataclasses.fields(lbt.files.Telemetry):
        if field.name in but:
            continue
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, lbt.models.PositionLoop):
            assert dataclasses.asdict(a) == dataclasses.asdict(b)
        elif isinstance(a, np.ndarray):
            assert a.shape == b.shape, field.name
            assert np.allclose(a, b, rtol=rtol, atol=0), field.name
            assert not b.flags.writeable
        elif isinstance(a, float) and rtol:
            assert b == pytest.approx(a, rel=rtol), field.name
        else:
            assert a == b, field.name
            assert type(a) is type(b), field.name
    return True


finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
words = st.text(max_size=30)


@st.composite
def telemetries(draw):
    frames, m, q = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 3))

    def series(columns):
        values = draw(st.lists(finite, min_size=frames * columns, max_size=frames * columns))
        return np.reshape(values, (frames, columns))

    optional = {
        "delay_frames": st.floats(0, 1000),
        "sensor_gain": st.floats(1e-300, 1e300),
        "diameter_m": st.floats(0.1, 50),
    }
    fields = {k: draw(s) for k, s in optional.items() if draw(st.booleans())}
    fields |= {"total_nm": series(2)} if draw(st.booleans()) else {}
    values = st.one_of(words, st.booleans(), st.integers(-(2**70), 2**70), finite)
    metadata = draw(st.dictionaries(st.text(min_size=1, max_size=20), values, max_size=4))
    series_of = {"commands": series(m), "measurements": series(q), "metadata": metadata}
    return lbt.files.Telemetry(frame_rate_hz=draw(st.floats(1e-3, 1e6)), **series_of, **fields)
