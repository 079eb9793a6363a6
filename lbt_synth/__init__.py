"""Certified convex synthesis of tip/tilt controllers for adaptive optics.

The names of a design script and the rooms are listed in ``__init__.pyi`` and are imported when
first used, so that ``import lbt_synth`` costs nothing.
"""

__version__ = "0.3.0"


def _read_names():
    """Return what looks names up, lists them for ``dir``, and lists them for ``import *``."""
    known = globals()
    if "_names" not in known:
        import lazy_loader

        known["_names"] = lazy_loader.attach_stub(__name__, __file__)
    return known["_names"]


def __dir__():
    return _read_names()[1]()


def __getattr__(name):
    """Import a name when it is first used, or say in which room it is."""
    import_lazily, _, names = _read_names()
    if name == "__all__":
        return names
    try:
        return import_lazily(name)
    except AttributeError:
        room = None if name.startswith("_") else _find_room(name)
        if room is None:
            raise
        where = f"lbt_synth.{room}.{name}"
        raise AttributeError(f"no name {name!r} in lbt_synth; try {where}.") from None


def _find_room(name):
    """Return the room that has a public name; None if none has."""
    from pathlib import Path

    package, known = Path(__file__).parent, globals()
    if "_stubs" not in known:
        files = (package / "errors.py", *sorted(package.glob("*/**/__init__.pyi")))
        known["_stubs"] = {file: file.read_text(encoding="utf-8") for file in files}
    for file, text in known["_stubs"].items():
        if f" as {name}\n" in text or f"class {name}(" in text:
            folders = file.with_suffix("").relative_to(package).parts
            return ".".join(part for part in folders if part != "__init__")
    return None
