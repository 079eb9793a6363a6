"""Telemetry: made of a simulation, saved to files in our layout or another, loaded and checked."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth
from lbt_synth.errors import OutputError, ProblemError, TelemetryError
from lbt_synth.files.file_checks import READERS, FileKind
from lbt_synth.files.telemetry import aot
from lbt_synth.files.telemetry.telemetry import FACTS, LAYERS, REQUIRED, Scalar, Telemetry
from lbt_synth.loop import Imaging
from lbt_synth.loop.simulation import Simulation
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.storage.array_file import Cards
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray, integer, require_instance

Meta = dict[str, Any]
_ENDINGS = ".fits, .npz or .aot.fits"
_KINDS = {".aot.fits": "aot", ".fits": "fits", ".npz": "npz"}  # the longer ending first
_KIND = FileKind(
    name="telemetry file",
    schema="lbt_synth telemetry",
    version=2,
    error=TelemetryError,
    version_error=TelemetryError,
    again="Try another copy, or write it again with lbt.files.save_telemetry.",
)


def require_telemetry_name(path: str | os.PathLike[str]) -> str:
    """Return the format of a file that is to be written."""
    target = Path(path)
    kind = next((_KINDS[end] for end in _KINDS if target.name.lower().endswith(end)), None)
    if kind is None:
        raise OutputError(f"telemetry must end in {_ENDINGS}; got {target.name!r}.", path=target)
    if kind == "aot":
        aot.require_aotpy(target)
    return kind


def save_telemetry(path: str | os.PathLike[str], telemetry: Telemetry) -> Path:
    """Write telemetry to a file, whole or not at all.

    Parameters
    ----------
    path : path-like
        File to write; the ending chooses the format: ``.fits`` or ``.npz`` in the layout of
        this package, ``.aot.fits`` in that of the Adaptive Optics Telemetry standard (which
        needs the extra ``aot`` and does not hold everything).
    telemetry : Telemetry
        The telemetry.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        If the name is none of these, the file cannot be written, or the extra is missing.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> seen = lbt.files.Telemetry(
    ...     frame_rate_hz=800, commands=[[0.0], [1.5]], measurements=[[3.0], [2.0]]
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = lbt.files.save_telemetry(pathlib.Path(folder) / "night.fits", seen)
    ...     lbt.files.load_telemetry(file).commands.ravel().tolist()
    [0.0, 1.5]
    """
    target = Path(path)
    kind = require_telemetry_name(target)
    if not isinstance(telemetry, Telemetry):
        raise OutputError(
            f"a telemetry file holds a Telemetry; got {type(telemetry).__name__}.", path=target
        )
    if kind == "aot":
        return write_atomically(target, aot.to_bytes(telemetry, target))
    arrays, meta = pack(telemetry)
    cards = partial(primary_cards, telemetry)
    return _KIND.write(target, arrays, meta, cards, layer_cards(telemetry))


def load_telemetry(path: str | os.PathLike[str], *, loop: str | int | None = None) -> Telemetry:
    """Read a telemetry file and check it: schema, digest, shapes, finiteness.

    Parameters
    ----------
    path : path-like
        File in the layout of this package (``.fits``, ``.npz``) or of the Adaptive Optics
        Telemetry standard (``.fits``); the header of a FITS file says which of the two it is.
    loop : str or int, optional
        Name or number (from 0) of a control loop of the standard; the first by default.

    Returns
    -------
    Telemetry
        The telemetry.

    Raises
    ------
    TelemetryError
        If the file is missing, damaged, foreign, of a later layout, or the extra ``aot`` is
        needed and missing.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.files.load_telemetry("nowhere.fits")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.TelemetryError: cannot read nowhere.fits: No such file or directory.
    """
    source = Path(path)
    if source.suffix.lower() not in READERS:
        raise TelemetryError(f"telemetry must end in {_ENDINGS}; got {source.name!r}.", path=source)
    content, is_fits = read_bytes(source, TelemetryError), source.suffix.lower() == ".fits"
    with _KIND.rebuilding(source):
        if is_fits and aot.is_aot(content):
            return aot.from_bytes(content, source, loop)
        if loop is not None:
            raise TelemetryError(f"{source}: {aot.NO_LOOPS}", path=source)
        return unpack(*_KIND.decode(content, source))


def pack(telemetry: Telemetry) -> tuple[dict[str, npt.NDArray[Any]], Meta]:
    """Return the arrays and the metadata."""
    held = {name: getattr(telemetry, layer.field) for name, layer in LAYERS.items()}
    arrays = {name: array for name, array in held.items() if array is not None}
    meta: Meta = {
        "schema": _KIND.schema,
        "schema_version": _KIND.version,
        "library_version": lbt_synth.__version__,
        "convention": telemetry.convention,
        **{name: getattr(telemetry, name) for name in FACTS},
        "metadata": dict(telemetry.metadata),
    }
    if telemetry.mirror is not None and telemetry.mirror_taps is not None:
        meta |= {"mirror": asdict(telemetry.mirror), "mirror_taps": telemetry.mirror_taps.tolist()}
    return arrays, meta


def unpack(arrays: dict[str, FloatArray], meta: Meta) -> Telemetry:
    """Rebuild telemetry; missing keys raise KeyError, what does not fit a ProblemError."""
    if unknown := arrays.keys() - LAYERS.keys():
        raise ValueError(f"it has arrays that no telemetry has: {', '.join(sorted(unknown))}")
    fields: dict[str, Any] = {
        layer.field: arrays[name]
        for name, layer in LAYERS.items()
        if name in arrays or layer.field in REQUIRED
    }
    if "mirror" in meta:  # a mirror that settles at once is not in the file
        fields["mirror"] = PositionLoop(**meta["mirror"])
    usual = {"shown_unit": "nm"}  # of a file that does not say it
    fields |= {name: (usual | meta)[name] for name in FACTS}
    return Telemetry(**fields, metadata=dict(meta["metadata"]))


def primary_cards(telemetry: Telemetry, meta: Meta) -> dict[str, tuple[Any, str]]:
    """Cards for people who look at the header; META is what is read back."""
    cards = {
        card: (getattr(telemetry, name), f"[{unit}] {meaning}" if unit else meaning)
        for name, (card, unit, meaning) in FACTS.items()
    }
    return {
        "CREATOR": (f"lbt_synth {meta['library_version']}", "writer of this file"),
        "LBTTELEM": (_KIND.version, "version of the lbt_synth telemetry layout"),
        **{card: fact for card, fact in cards.items() if fact[0] is not None},
        "TIMING": (telemetry.convention, ""),
        "SHA256": (meta["digest"], ""),
    }


def layer_cards(telemetry: Telemetry) -> dict[str, Cards]:
    """Cards of each array: unit, meaning, axes."""
    out: dict[str, Cards] = {}
    for name, layer in LAYERS.items():
        cards: dict[str, tuple[Any, str]] = {}
        if unit := layer.unit_in(telemetry):
            cards["BUNIT"] = (unit, "rms of wavefront" if unit == "nm" else "")
        cards["CONTENT"] = (layer.meaning, "")
        for number, axis in enumerate(reversed(layer.axes.split(", ")), start=1):
            cards[f"CTYPE{number}"] = (axis.upper(), "")  # FITS counts axes from the fastest
        out[name] = cards
    return out


def telemetry_from_simulation(
    simulation: Simulation,
    hardware: LoopHardware,
    *,
    case: int = 0,
    sensor_gain: float | None = None,
    imaging: Imaging | None = None,
    metadata: Mapping[str, Scalar] | None = None,
) -> Telemetry:
    """Telemetry of one case of a simulation.

    Parameters
    ----------
    simulation : Simulation
        The simulation.
    hardware : LoopHardware
        The loop that was simulated.
    case : int, optional
        Which case, from 0.
    sensor_gain : float, optional
        Sensor gain of the truth, relative to the sensor matrix of the loop.
    imaging : Imaging, optional
        The camera: gives the telescope, the wavelength and, of one or two modes, the Strehl
        ratio of the case.
    metadata : mapping, optional
        Anything else; see :class:`Telemetry`. The seed and the Strehl ratio are added.

    Returns
    -------
    Telemetry
        Series in nm, with the true phase before and after the correction.

    Raises
    ------
    ProblemError
        If there is no such case, or the loop is not that of the simulation.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100),),
    ... )
    >>> run = lbt.simulate(lazy.controller, shake, hardware=path, frames=100)
    >>> seen = lbt.files.telemetry_from_simulation(run, path)
    >>> bool(abs(seen.measurements[1:] - seen.residual_nm[:-1]).max() < 1e-9)  # no noise
    True
    """
    require_instance(simulation, Simulation)
    require_instance(hardware, LoopHardware)
    case = integer(case, "case", at_least=0)
    cases = len(simulation.commands)
    if case >= cases:
        raise ProblemError(f"case must be below the number of cases, {cases}; got {case}.")
    if simulation.frame_rate_hz != hardware.frame_rate_hz:
        raise ProblemError(
            f"hardware must be that of the simulation, at {simulation.frame_rate_hz:g} Hz; got "
            f"one at {hardware.frame_rate_hz:g} Hz."
        )
    residual, facts = simulation.residual_nm[case], {"seed": simulation.seed, **(metadata or {})}
    if imaging is not None and residual.shape[1] <= 2:  # the jitter of an image has two axes
        strehl = simulation.strehl(imaging)[case]
        facts["strehl"] = float(np.clip(strehl, 0, 1))  # a mean of cosines
    return Telemetry(
        frame_rate_hz=simulation.frame_rate_hz,
        delay_frames=hardware.delay_frames,
        mirror=hardware.mirror,
        commands=simulation.commands[case],
        measurements=simulation.measurements[case],
        residual_nm=residual,
        total_nm=simulation.total_nm[case],
        interaction_matrix=hardware.sensor,
        influence_matrix=hardware.influence,
        sensor_gain=sensor_gain,
        diameter_m=None if imaging is None else imaging.diameter_m,
        obstruction=None if imaging is None else imaging.obstruction,
        imaging_wavelength_um=None if imaging is None else imaging.wavelength_um,
        metadata=facts,
    )
