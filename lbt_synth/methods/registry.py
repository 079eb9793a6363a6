"""The registry of the methods of synthesis: all of them, and each by name."""

from __future__ import annotations

import difflib
import pkgutil
from functools import cache
from importlib import import_module

from lbt_synth import methods as folder
from lbt_synth.errors import ProblemError
from lbt_synth.methods.method import Method


@cache
def _methods_of_folder() -> dict[str, Method]:
    modules = [
        import_module(f"{folder.__name__}.{module.name}")
        for module in pkgutil.iter_modules(folder.__path__)
    ]
    methods = [module.METHOD for module in modules if hasattr(module, "METHOD")]
    return {method.name: method for method in sorted(methods, key=lambda method: method.name)}


def all_methods() -> dict[str, Method]:
    """Return the methods of synthesis."""
    return dict(_methods_of_folder())


def method_named(name: str) -> Method:
    """Return a method by its name.

    Parameters
    ----------
    name : str
        The name.

    Returns
    -------
    Method
        The method.

    Raises
    ------
    ProblemError
        If there is none of this name.

    Examples
    --------
    >>> from lbt_synth.methods import method_named
    >>> method_named("kalman").title
    'Kalman filter'
    """
    methods = all_methods()
    if name not in methods:
        close = difflib.get_close_matches(name, methods, n=1)
        hint = f" Did you mean {close[0]}?" if close else ""
        raise ProblemError(f"method must be one of {', '.join(methods)}; got {name!r}.{hint}")
    return methods[name]


def option_names() -> list[str]:
    """Return the names of the options of all methods."""
    return sorted({name for m in all_methods().values() for name in m.options.model_fields})


def design_title(name: str) -> str:
    """Return what sentences call a design with a name in ``Design.method``, else the name."""
    return all_methods()[name].title if name in all_methods() else name


def design_label(name: str) -> str:
    """Return what figures call a design with a name in ``Design.method``, else the name."""
    return all_methods()[name].label if name in all_methods() else name


def record_methods() -> list[str]:
    """Return the names of the methods that need no more than a plant identified from a record."""
    return [n for n, m in all_methods().items() if m.estimator and not m.needs_options]


def gain_robust_method() -> str:
    """Return the name of the method that designs for a plant and an interval of sensor gains."""
    return next(n for n, m in all_methods().items() if m.plant_section is not None)


def default_method() -> str:
    """Return the name of the method that is designed unless another is named."""
    return reference_methods(estimators_only=True)[0].name


def reference_methods(*, estimators_only: bool = False) -> list[Method]:
    """Return the methods that studies compare designs with, in their order."""
    ranked = [
        (method.reference_rank, method.name, method)
        for method in all_methods().values()
        if method.reference_rank is not None and (method.estimator or not estimators_only)
    ]
    return [method for *_, method in sorted(ranked, key=lambda entry: entry[:2])]
