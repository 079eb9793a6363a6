"""The end-to-end system of a configuration and a command line, and its calibration."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace

from lbt_synth.cli.progress import count_progress
from lbt_synth.config import load_config
from lbt_synth.interop import Calibration, EndToEndSetup, calibrate


def load_setup(arguments: Namespace) -> EndToEndSetup:
    """Load the end-to-end setup of a configuration, with the changes of the command line."""
    setup = load_config(arguments.config).end_to_end
    if arguments.pixels is not None:
        setup = replace(setup, system=replace(setup.system, pixels=arguments.pixels))
    changes = {
        name: getattr(arguments, name)
        for name in ("frames", "settle_frames", "seed")
        if getattr(arguments, name) is not None
    }
    return replace(setup, **changes)


def calibrate_setup(setup: EndToEndSetup, arguments: Namespace) -> Calibration:
    """Calibrate a system, or take its calibration from the cache, behind a progress bar."""
    with count_progress(
        total=setup.system.modes, what="calibration", quiet=arguments.json
    ) as count:
        return calibrate(setup.system, cache=arguments.cache, progress=count)
