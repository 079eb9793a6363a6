"""The options of the methods of synthesis as arguments: one for each name, with the help of all."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lbt_synth.methods.method import Method
from lbt_synth.methods.registry import all_methods, option_names


def add_method_options(parser: ArgumentParser) -> None:
    """Add ``--method`` and the options of all methods; each method checks its own."""
    methods = all_methods()
    parser.add_argument(
        "--method",
        choices=tuple(methods),
        required=True,
        help="; ".join(f"{name}: {method.title}" for name, method in methods.items()),
    )
    for name in option_names():
        owners = [method for method in methods.values() if name in method.options.model_fields]
        helps: dict[str, list[str]] = {}
        for method in owners:
            helps.setdefault(_help_text(method, name), []).append(method.name)
        text = "; ".join(f"{', '.join(names)}: {text}" for text, names in helps.items())
        kinds = _kinds(owners[0].options.model_fields[name])
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=next((kind for kind in (int, float) if kind in kinds), str),
            help=text.replace("%", "%%"),
        )


def _kinds(option: FieldInfo) -> tuple[Any, ...]:
    """Return the types of an option, one or those of a union."""
    if get_origin(option.annotation) is Literal:
        return (option.annotation,)
    return get_args(option.annotation) or (option.annotation,)


def _help_text(method: Method, name: str) -> str:
    """Return the description of an option with its choices or its range, and its default."""
    option = method.options.model_fields[name]
    choices = [c for kind in _kinds(option) if get_origin(kind) is Literal for c in get_args(kind)]
    low, high = (
        next((getattr(limit, end) for limit in option.metadata if hasattr(limit, end)), None)
        for end in ("ge", "le")
    )
    text = option.description or ""
    if choices:
        text += f", {' or '.join(choices)}"
    elif low is not None and high is not None:
        text += f", {low} to {high}"
    if option.default in (None, PydanticUndefined):
        return text
    if name in method.configurable:
        return f"{text} (default: the configuration's, else {option.default:g})"
    return f"{text} (default {option.default})"
