"""Cases of an end-to-end simulation in JSON, so that a study of many can go on where it stopped."""

from __future__ import annotations

import importlib.metadata
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from lbt_synth.interop.specula.optics import EndToEndSystem
from lbt_synth.interop.specula.simulation import EndToEndRun, EndToEndSetup
from lbt_synth.linear import Controller
from lbt_synth.models import (
    DriftingVibration,
    LoopHardware,
    PositionLoop,
    SinusoidalVibration,
    Vibration,
)
from lbt_synth.models.vibration import TrueVibration


def make_case(
    setup: EndToEndSetup,
    controller: Controller | None,
    *,
    vibrations: Sequence[TrueVibration] = (),
    seed: int = 0,
) -> dict[str, Any]:
    """Return all that a run depends on, in values that JSON can hold.

    Vibrations and seed replace those of the set-up. Without a controller, integrators control tip
    and tilt.
    """
    settings = asdict(replace(setup, vibrations=tuple(vibrations), seed=seed))
    lines, system = list(settings.pop("vibrations")), settings.pop("system")
    settings.pop("motions")  # a case has no channels
    hardware = system.pop("hardware")  # its two matrices are the identity
    matrices = None
    if controller is not None:
        matrices = {name: getattr(controller, name).tolist() for name in "ABCD"}
        matrices["dt_s"] = controller.dt_s
    return {
        "versions": {name: _installed_version(name) for name in ("lbt-synth", "specula")},
        "system": system,
        "hardware": {name: hardware[name] for name in ("frame_rate_hz", "delay_frames", "mirror")},
        "setup": settings,
        "vibrations": lines,
        "controller": matrices,
    }


def run_case(
    case: Mapping[str, Any], *, cache: str | os.PathLike[str] | None = None
) -> dict[str, Any]:
    """Run a case made by :func:`make_case` and return its summary.

    ``cache`` is the directory of calibrations and phase screens.
    """
    system = EndToEndSystem(hardware=_build_hardware(case["hardware"]), **case["system"])
    lines = tuple(_build_vibration(line) for line in case["vibrations"])
    setup = EndToEndSetup(system=system, vibrations=lines, **case["setup"])
    matrices = case["controller"]
    controller = None if matrices is None else Controller(**matrices)
    return summarise_run(setup.run(controller, cache=cache))


def summarise_run(run: EndToEndRun) -> dict[str, Any]:
    """Return the main numbers of a run; None stands for NaN, which JSON does not have."""
    rms = run.rms_nm
    return {
        "strehl": run.strehl,
        "strehl_error": None if math.isnan(run.strehl_error) else run.strehl_error,
        "other_modes_strehl": run.other_modes_strehl,
        "tip_rms_nm": float(rms[0]),
        "tilt_rms_nm": float(rms[1]),
        "other_modes_rms_nm": float((rms[2:] ** 2).sum() ** 0.5),
        "tip_tilt_gain": run.tip_tilt_gain,
        "tip_tilt_gain_error": run.tip_tilt_gain_error,
        "tip_tilt_noise_nm": run.tip_tilt_noise_nm,
    }


def _installed_version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _build_hardware(values: Mapping[str, Any]) -> LoopHardware:
    mirror = values["mirror"]
    return LoopHardware(**{**values, "mirror": None if mirror is None else PositionLoop(**mirror)})


def _build_vibration(line: Mapping[str, Any]) -> TrueVibration:
    """Rebuild a vibration; its fields tell which of the three types it has."""
    values = {**line, "direction": tuple(line["direction"])}
    if "start_hz" in line:
        return DriftingVibration(**values)
    return Vibration(**values) if "damping" in line else SinusoidalVibration(**values)
