"""Calibration of an end-to-end system: modes, interaction matrix, reconstructor, cached."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.design.modal import Reconstructor, reconstructor
from lbt_synth.interop.specula.optics import (
    EndToEndSystem,
    Modes,
    Optics,
    make_modes,
    specula_version,
)
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz
from lbt_synth.storage.atomic_files import make_directory, write_atomically
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_LAYOUT = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What is measured once, before a loop is closed."""

    modes: Modes  # shapes of the mirror
    reference: FloatArray  # (q,): slopes of a flat wavefront
    # generalised inverse of the interaction matrix (slopes per nanometre of each mode)
    reconstructor: Reconstructor
    key: str  # digest of everything that it depends on
    cached: bool  # whether it came from the cache


def cache_directory(path: str | os.PathLike[str] | None = None) -> Path:
    """Return the directory for calibrations and phase screens; create it if it is missing."""
    if path is None:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        path = Path(base) / "lbt_synth"
    return make_directory(path)


def calibrate(
    system: EndToEndSystem,
    *,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Calibration:
    """Compute the modes, measure the interaction matrix without noise, and invert it.

    Each mode is pushed and pulled by ``system.calibration_nm`` on a flat wavefront. The
    result is cached under a digest of everything that it depends on, including SPECULA's
    version; what a damaged file held is measured again.

    Parameters
    ----------
    system : EndToEndSystem
        The system.
    cache : path-like, optional
        Directory of the cache; see :func:`cache_directory`.
    progress : callable, optional
        Called with the number of modes measured since its last call.

    Returns
    -------
    Calibration
        The calibration.

    Raises
    ------
    MissingExtraError
        If SPECULA is missing.
    ProblemError
        If the mirror cannot carry the modes, or the sensor cannot tell them apart.
    OutputError
        If the cache cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> system = lbt.load_config("examples/lbt.yaml").end_to_end.system
    >>> found = lbt.interop.calibrate(system)  # doctest: +SKIP
    >>> found.reconstructor.condition_number < 12  # doctest: +SKIP
    True
    >>> lbt.interop.calibrate("examples/lbt.yaml")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: expected an EndToEndSystem; got str.
    """
    require_instance(system, EndToEndSystem)
    facts = {"layout": _LAYOUT, "specula": specula_version(), **system.calibration_facts()}
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    path = cache_directory(cache) / f"calibration-{key[:16]}.npz"
    arrays = _read_cached(path, key)
    cached = arrays is not None
    if arrays is None:
        arrays = _measure(system, progress)
        meta = {"key": key, "facts": facts}
        meta["digest"] = digest(arrays, meta)
        write_atomically(path, npz_bytes(arrays, json.dumps(meta)))
    elif progress is not None:
        progress(system.modes)
    return Calibration(
        modes=Modes(mask=arrays["MASK"] > 0, shapes=arrays["SHAPES"].astype(np.float32)),
        reference=frozen_copy(arrays["REFERENCE"]),
        reconstructor=reconstructor(arrays["INTERACTION"]),
        key=key,
        cached=cached,
    )


def _measure(
    system: EndToEndSystem, progress: Callable[[int], None] | None
) -> dict[str, npt.NDArray[Any]]:
    """Compute the modes; measure the slopes of a flat wavefront and of each mode."""
    modes = make_modes(system)
    optics = Optics(system, modes)
    still, n = np.zeros(2), len(modes.shapes)
    reference = optics.expose(np.zeros(n), still)
    matrix = np.empty((reference.size, n))
    for mode in range(n):
        push = np.zeros(n)
        push[mode] = -system.calibration_nm  # a correction is subtracted from the phase
        pair = optics.expose(push, still) - optics.expose(-push, still)
        matrix[:, mode] = pair / (2 * system.calibration_nm)
        if progress is not None:
            progress(1)
    return {
        "MASK": modes.mask.astype(np.uint8),
        "SHAPES": modes.shapes,
        "REFERENCE": reference,
        "INTERACTION": matrix,
    }


def _read_cached(path: Path, key: str) -> dict[str, npt.NDArray[Any]] | None:
    """Return the arrays of a file, None if it is missing, damaged or another one."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        arrays, text = read_npz(path.read_bytes())
        meta = json.loads(text)
        if meta["key"] == key and meta["digest"] == digest(arrays, meta):
            return dict(arrays)
    return None
