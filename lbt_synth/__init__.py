"""Certified convex synthesis of tip/tilt controllers for adaptive optics.

A design script takes these names; ``help(lbt_synth.kalman)`` explains one:

- plants: LoopHardware, Atmosphere, Vibration, Truth, tip_tilt_plant, EstimationProblem, load_config
- designs: kalman, hinf, mixed, lqg, robust, integrator, and h2_controller, hinf_controller and
  mixed_controller for any plant; Design, Controller, solve_dare, hinf_norm
- loops: close_loop, loop_margins, residual_budget, simulate, strehl, Imaging
- records: load_record, identify, design_from_record
- files: save_gain, load_gain

The rooms hold the rest: config, design, errors, files, identification, interop, linear, loop,
models, report, studies. ``lbt-synth`` does all of it at the terminal, and
``python -m lbt_synth --help`` lists its commands. Names are imported when first used, so that
``import lbt_synth`` costs nothing.

    >>> import lbt_synth as lbt
    >>> loop = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lbt.integrator(loop, gain=0.5).certificate.passed
    True
"""

__version__ = "0.3.0"


def _read_names():
    """Return what looks names up, and what lists them for ``dir``."""
    known = globals()
    if "_names" not in known:
        import lazy_loader

        known["_names"] = lazy_loader.attach_stub(__name__, __file__)
    return known["_names"]


def __dir__():
    return _read_names()[1]()


def __getattr__(name):
    """Import a name when it is first used, or say in which room it is."""
    try:
        return _read_names()[0](name)
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
