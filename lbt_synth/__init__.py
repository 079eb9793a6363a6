"""Certified convex synthesis of tip/tilt controllers for adaptive optics.

The names of a design script and the rooms are listed in ``__init__.pyi`` and are imported when
first used, so that ``import lbt_synth`` costs next to nothing.
"""

from pathlib import Path
from typing import Any

import lazy_loader

_import_lazily, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """Import a name when it is first used, or say in which room it is."""
    try:
        return _import_lazily(name)
    except AttributeError:
        package = Path(__file__).parent
        for file in (package / "errors.py", *sorted(package.glob("*/**/__init__.pyi"))):
            text = file.read_text(encoding="utf-8")
            if f" as {name}\n" in text or f"class {name}(" in text:
                folders = file.with_suffix("").relative_to(package).parts
                room = ".".join(part for part in folders if part != "__init__")
                raise AttributeError(
                    f"no name {name!r} in lbt_synth; try lbt_synth.{room}.{name}."
                ) from None
        raise
