"""What is wrong with a configuration, in one sentence that names the path of the key."""

from __future__ import annotations

from typing import Any, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lbt_synth.config.schema import FileSection
from lbt_synth.errors import suggest_word
from lbt_synth.methods.quantities import EACH, ONE


def describe_error(
    error: ValidationError, schema: type[BaseModel] = FileSection
) -> tuple[str, str]:
    """Return one sentence on the first mistake, and the path of its key."""
    details = error.errors()
    # an unknown key says more than the missing one that it was meant to be
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    location = _plain_location(first)
    key = _key_path(location)
    more = f" ({len(details) - 1} more after this one.)" if len(details) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _list_keys(schema, location[:-1])
        if str(location[-1]) in known:
            return f"{key} goes with another kind; leave it out, or change the kind.{more}", key
        return f"unknown key {key}; {suggest_word(str(location[-1]), known)}{more}", key
    missing = [_key_path(_plain_location(d)) for d in details if d["type"] == "missing"]
    if first["type"] == "missing":
        if len(missing) == 1:
            return f"the key {key} is missing.{more}", key
        rest = len(details) - len(missing)
        more = f" ({rest} more after these.)" if rest else ""
        return f"the keys {', '.join(missing)} are missing.{more}", key
    if first["type"] == "value_error":
        return f"{key}: {first['ctx']['error']}.{more}", key
    if first["type"] == "too_short" and key.endswith("vibrations"):
        return f"{key} is empty; leave the key out for a model without vibrations.{more}", key
    if first["type"] == "union_tag_invalid":
        expected, got = first["ctx"]["expected_tags"], first["ctx"]["tag"]
        return f"{key}.kind must be one of {expected}; got {got!r}.{more}", key
    if first["type"] == "model_type":
        return f"{key} must be a mapping of keys; got {first['input']!r}.{more}", key
    text = first["msg"][0].lower() + first["msg"][1:]
    return f"{key}: {text}; got {first['input']!r}.{more}", key


def _plain_location(detail: ErrorDetails) -> tuple[int | str, ...]:
    """Return where a mistake is, without the tags of what may stand there."""
    return tuple(p for p in detail["loc"] if p not in ("ar1", "ar2", "ar", ONE, EACH))


def _key_path(location: tuple[int | str, ...]) -> str:
    out = ""
    for part in location:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else str(part)
    return out


def _list_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the schema knows at a location."""
    here: list[type[BaseModel]] = [model]
    chosen_name = False  # the next part is a name that the file chooses, a key of a mapping
    for part in location:
        if isinstance(part, int) or chosen_name:
            chosen_name = False
            continue
        fields = [
            field
            for section in here
            for name, field in section.model_fields.items()
            if part == (field.alias or name)
        ]
        chosen_name = any(get_origin(field.annotation) is dict for field in fields)
        here = [found for field in fields for found in _find_models(field.annotation)]
    return sorted(
        {field.alias or name for section in here for name, field in section.model_fields.items()}
    )


def _find_models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _find_models(arg)]
