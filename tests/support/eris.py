"""The example on the vibration spectrum of VLT/ERIS: its module, its record, and the model of it."""

import functools
import importlib.util
import sys

from support.plants import ROOT

import lbt_synth as lbt

ERIS_FILE = ROOT / "examples" / "data" / "eris_vibrations_psd.fits"


@functools.cache
def eris_example():
    path = ROOT / "examples" / "eris_vibrations.py"
    spec = importlib.util.spec_from_file_location("eris_vibrations", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["eris_vibrations"] = module  # its dataclass looks there
    spec.loader.exec_module(module)
    return module


@functools.cache
def eris_record():
    return eris_example().record()


@functools.cache
def eris_model():
    return lbt.identify(eris_record(), frame_rate_hz=1000, delay_frames=2)
