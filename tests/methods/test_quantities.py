"""Every number of a configuration has limits, at which it is computed or refused."""

import contextlib
from functools import partial, reduce
from itertools import product
from typing import get_args, get_origin

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from support.configs import GOOD, change_key, numbers_of, write_config
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.config.samples import parse_path
from lbt_synth.config.schema import FileSection

FROM_ZERO = """
    obstruction read_noise_electrons damping proportional_per_s2 derivative_per_s feed_forward
    delay_samples frequency_error_hz phase_margin_deg modulus_margin leak
    command_weight low_hz delay_error_frames pole loss seed settle_frames gain
"""
SIGNED = """
    matrix covariance influence_matrix coefficients direction_deg phase_deg errors_hz
    delay_errors_frames wind_direction_deg
"""


BEYOND = {"ge": -1, "gt": 0, "le": 1, "lt": 0}  # a step from a limit to what is refused


def declared_numbers(annotation, bounds=(), path="", section=None, lists=0):
    """Yield each number that a type can hold, its bounds, section, kind and depth in lists."""
    bounds = (*bounds, *getattr(annotation, "__metadata__", ()))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            declared = field.annotation, tuple(field.metadata), f"{path}.{name}"
            yield from declared_numbers(*declared, annotation)
    elif annotation in (int, float):
        limits = [getattr(bound, "metadata", None) or [bound] for bound in bounds]
        yield path, [one for some in limits for one in some], section, annotation, lists
    deeper = lists + (get_origin(annotation) is list)
    for argument in get_args(annotation):
        yield from declared_numbers(argument, bounds, path, section, deeper)


def test_every_number_of_the_schema_has_limits_that_hold():
    numbers = list(declared_numbers(FileSection))
    assert len(numbers) > 80
    for path, bounds, section, kind, lists in numbers:
        low, high = (
            [getattr(bound, name) for bound in bounds for name in names if hasattr(bound, name)]
            for names in (("ge", "gt"), ("le", "lt"))
        )
        least, most, name = max(low), min(high), path.rpartition(".")[2]
        assert most <= 1e12 or name == "seed", path
        is_signed = least == -most and name in SIGNED.split()
        assert least > 1e-13 or is_signed or (least == 0 and name in FROM_ZERO.split()), path
        for bound, (relation, step) in product(bounds, BEYOND.items()):
            if hasattr(bound, relation):
                limit = kind(getattr(bound, relation))
                value = limit + step if kind is int else np.nextafter(limit, limit + step).item()
                content = {name: reduce(lambda inner, _: [inner], range(lists), value)}
                error = refused(partial(section.model_validate, content), ValidationError, name)
                mistakes = [one["type"] for one in error.errors() if one["loc"][0] == name]
                assert ["than" in mistake for mistake in mistakes] == [True], (path, limit)


def limits(path):
    """Yield the limits that the messages name where a number is far too small or too large."""
    for value in (-(10**12), 10**12, -1e12, 1e12):
        try:
            FileSection.model_validate(change_key(path, value))
        except ValidationError as error:
            for name, limit in error.errors()[0].get("ctx", {}).items():
                yield limit + {"gt": 1e-6, "lt": -1e-6}.get(name, 0)


@settings(max_examples=10)
@given(place=st.sampled_from([parse_path(path) for path, _ in numbers_of(GOOD)]), data=st.data())
def test_a_loop_is_computed_at_the_limits(tmp_path_factory, place, data):
    """A configuration with a number at its limit gives numbers, or is refused."""
    value = data.draw(st.sampled_from([*limits(place)]))
    file = write_config(tmp_path_factory.mktemp("limits"), change_key(place, value))
    with contextlib.suppress(lbt.LbtSynthError):
        config = lbt.load_config(file)
        design, gain = config.design("kalman"), config.truth.sensor_gain
        loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=gain)
        budget = lbt.residual_budget(loop, config.truth)
        assert 0 < budget.rms_nm < 1e10
        assert 0 <= lbt.strehl(budget, config.imaging) <= 1
