"""A method of synthesis with its options, as a command, a study or a record asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from lbt_synth.errors import ProblemError, suggest_word
from lbt_synth.methods.method import DesignInputs, Method, Section
from lbt_synth.methods.registry import METHODS, method_named

if TYPE_CHECKING:
    from lbt_synth.design.result import Design
    from lbt_synth.models import TipTiltPlant

_SHORT_WORDS = {
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "greater than": "above",
    "less than": "below",
    "a finite number": "finite",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignRequest:
    """A method of synthesis and its options; the inputs of a design give the others."""

    method: Method
    given: Mapping[str, Any]  # the options that were given
    options: Section  # all of them

    @property
    def text(self) -> str:
        """Method and options as people read them."""
        given = ", ".join(f"{name} {value}" for name, value in self.given.items())
        return f"{self.method.name} ({given})" if given else self.method.name

    def build(self, inputs: DesignInputs) -> Design:
        """Design a controller; the inputs give defaults of options that are not given."""
        missing = (self.method.configurable & inputs.defaults.keys()) - self.given.keys()
        update = {name: inputs.defaults[name] for name in missing}
        options = self.options.model_copy(update=update)
        return self.method.build(inputs, options)


def design_request(name: str, given: Mapping[str, Any]) -> DesignRequest:
    """Check the options of a method, by their names in Python; raise ProblemError."""
    method = method_named(name)
    for option in given:
        if option not in method.options.model_fields:
            raise ProblemError(_describe_stranger(option, method))
    both = [option for option in given if option in method.exclusive]
    if len(both) > 1:
        names = ", ".join(sorted(method.exclusive & method.options.model_fields.keys()))
        raise ProblemError(f"method {name} takes at most one of {names}; got {' and '.join(both)}.")
    try:
        options = method.options.model_validate(dict(given))
    except ValidationError as error:
        raise ProblemError(_describe_error(error, method)) from None
    return DesignRequest(method=method, given=dict(given), options=options)


def _describe_stranger(option: str, method: Method) -> str:
    """Describe an option that a method does not have."""
    if owners := [m.name for m in METHODS.values() if option in m.options.model_fields]:
        return f"{option} goes with method {' or '.join(owners)}; got method {method.name}."
    suggestion = suggest_word(option, sorted(method.options.model_fields))
    return f"{option} is no option of method {method.name}; {suggestion}"


def _describe_error(error: ValidationError, method: Method) -> str:
    """Describe the first option that does not fit."""
    first = error.errors()[0]
    name = str(first["loc"][0])
    field = method.options.model_fields[name]
    if first["type"] == "missing":
        example = f"; try {name} {field.examples[0]}" if field.examples else ""
        return f"method {method.name} needs {name}, the {field.description}{example}."
    if first["type"] == "literal_error":
        expected = first["ctx"]["expected"].replace("'", "")
        return f"method {method.name} takes {name} {expected}; got {name} {first['input']}."
    limit = first["msg"].removeprefix("Input should be ")
    for long, short in _SHORT_WORDS.items():
        limit = limit.replace(long, short)
    got = first["input"]
    shown = f"{got:g}" if isinstance(got, float) else repr(got)
    extra = field.json_schema_extra  # advice where it is refused
    hint = extra.get("hint", "") if isinstance(extra, dict) else ""
    return f"{name} must be {limit}; got {shown}. {hint}".rstrip()


def reference_design(name: str, plant: TipTiltPlant, options: Mapping[str, Any]) -> Design:
    """Design a method for a plant as studies do that compare with it; it takes what it knows."""
    method = method_named(name)
    own = {key: value for key, value in options.items() if key in method.options.model_fields}
    request = design_request(name, {**method.reference_options, **own})
    return request.build(DesignInputs(plant=plant))
