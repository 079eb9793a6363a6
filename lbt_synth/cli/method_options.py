"""The options of the methods of synthesis as arguments: one for each name, with the help of all."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lbt_synth.cli.argument_kinds import option_name
from lbt_synth.methods.method import Method
from lbt_synth.methods.registry import all_methods, option_names

_LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def add_method_options(parser: ArgumentParser) -> None:
    """Add ``--method`` and the options of all methods; each method checks its own."""
    methods = all_methods()
    parser.add_argument(
        "--method",
        choices=tuple(methods),
        required=True,
        help="; ".join(
            name if name == method.title else f"{name}: {method.title}"
            for name, method in methods.items()
        ),
    )
    for name in option_names():
        owners = [method for method in methods.values() if name in method.options.model_fields]
        helps: dict[str, list[str]] = {}
        for method in owners:
            helps.setdefault(_help_text(method, name), []).append(method.name)
        text = "; ".join(f"{', '.join(names)}: {text}" for text, names in helps.items())
        if others := sorted({o for m in owners if name in m.exclusive for o in m.exclusive}):
            text += f"; at most one of {', '.join(map(option_name, others))}"
        kinds = _kinds(owners[0].options.model_fields[name])
        words = dict.fromkeys(c for m in owners for c in _choices(m.options.model_fields[name]))
        parser.add_argument(
            option_name(name),
            type=next((kind for kind in (int, float) if kind in kinds), str),
            metavar=f"{{{','.join(words)}}}" if words else None,
            help=text.replace("%", "%%"),
        )


def _kinds(option: FieldInfo) -> tuple[Any, ...]:
    """Return the types of an option, one or those of a union."""
    if get_origin(option.annotation) is Literal:
        return (option.annotation,)
    return get_args(option.annotation) or (option.annotation,)


def _choices(option: FieldInfo) -> list[str]:
    return [c for kind in _kinds(option) if get_origin(kind) is Literal for c in get_args(kind)]


def _help_text(method: Method, name: str) -> str:
    """Return the description of an option with its choices or its range, and its default."""
    option = method.options.model_fields[name]
    choices = _choices(option)
    limits = {
        end: getattr(limit, end)
        for limit in option.metadata
        for end in _LIMITS
        if getattr(limit, end, None) is not None
    }
    text = option.description or ""
    if choices and not all(choice in text for choice in choices):
        text += f", {' or '.join(choices)}"
    if limits:
        text += f", {' and '.join(f'{_LIMITS[end]} {limit:g}' for end, limit in limits.items())}"
    if option.default in (None, PydanticUndefined):
        return text
    if name in method.configurable:
        return f"{text} (default: the configuration's, else {option.default:g})"
    return f"{text} (default {option.default})"
