"""Every number of a configuration has limits; beyond them it is refused, at them it is computed."""

import contextlib
import copy
import math
from typing import get_args

from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from support.configs import write_config
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.config.schema import FileSection, describe_error

EXAMPLES = [
    YAML(typ="safe", pure=True).load(path.read_text())
    for path in sorted((ROOT / "examples").glob("lbt*.yaml"))
]
IMPOSSIBLE = [1e-300, 1e-12, 1e12, 1e200, -1.0, math.nan, math.inf]
FROM_ZERO = {*("damping", "gain", "leak", "loss", "low_hz", "obstruction"), "read_noise_electrons"}
PASS = {(name, value) for name in (*FROM_ZERO, "errors_hz") for value in (1e-300, 1e-12)}
PASS |= {("errors_hz", -1.0)}  # shifts have a sign


def declared_numbers(annotation, bounds=(), path=""):
    """Yield each number that a type of the schema can hold, with all its bounds."""
    bounds = (*bounds, *getattr(annotation, "__metadata__", ()))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            yield from declared_numbers(field.annotation, tuple(field.metadata), f"{path}.{name}")
    elif annotation in (int, float):
        limits = [getattr(bound, "metadata", None) or [bound] for bound in bounds]
        yield path, [one for some in limits for one in some]
    for part in get_args(annotation):
        yield from declared_numbers(part, bounds, path)


def numbers(content, path=()):
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from numbers(value, (*path, key))
        elif isinstance(value, int | float):
            yield (*path, key)


def changed(content, path, value):
    out = here = copy.deepcopy(content)
    for step in path[:-1]:
        here = here[step]
    here[path[-1]] = value
    return out


PLACES = [(content, path) for content in EXAMPLES for path in numbers(content)]


def limits(content, path):
    """The limits that the messages name where a number is far too small or too large."""
    for value in (-(10**12), 10**12, -1e12, 1e12):
        try:
            FileSection.model_validate(changed(content, path, value))
        except ValidationError as error:
            for name, limit in error.errors()[0].get("ctx", {}).items():
                yield limit + {"gt": 1e-6, "lt": -1e-6}.get(name, 0)


def test_every_number_of_the_schema_has_limits():
    found = list(declared_numbers(FileSection))
    assert len(found) > 80
    names = {"ge": "low", "gt": "low", "le": "high", "lt": "high"}
    for path, bounds in found:
        has = {names[name] for bound in bounds for name in names if hasattr(bound, name)}
        assert has == {"low", "high"}, path


def test_numbers_that_no_telescope_has_are_refused():
    passed = set()
    for content, path in PLACES:
        for value in IMPOSSIBLE:
            try:
                FileSection.model_validate(changed(content, path, value))
                passed.add(([step for step in path if isinstance(step, str)][-1], value))
            except ValidationError as error:
                text, key = describe_error(error)
                assert key.startswith(str(path[0]))
                assert text.startswith(key)
    assert passed == PASS


@settings(max_examples=10)
@given(place=st.sampled_from([*numbers(EXAMPLES[0])]), data=st.data())
def test_a_loop_is_computed_at_the_limits(tmp_path_factory, place, data):
    """A configuration with a number at its limit gives numbers, or is refused."""
    value = data.draw(st.sampled_from([*limits(EXAMPLES[0], place)]))
    file = write_config(tmp_path_factory.mktemp("limits"), changed(EXAMPLES[0], place, value))
    with contextlib.suppress(lbt.LbtSynthError):
        config = lbt.load_config(file)
        design, gain = config.design("kalman"), config.truth.sensor_gain
        loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=gain)
        budget = lbt.residual_budget(loop, config.truth)
        assert 0 < budget.rms_nm < 1e10
        assert 0 <= lbt.strehl(budget, config.imaging) <= 1
